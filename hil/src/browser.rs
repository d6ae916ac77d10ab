//! A real browser: Debian's Chromium, driven over WebDriver.

use crate::{project, wait_for};
use fantoccini::wd::WebDriverCompatibleCommand;
use fantoccini::{Client, ClientBuilder};
use http::Method;
use hyper_util::client::legacy::connect::HttpConnector;
use serde_json::{Value, json};
use std::net::{TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;
use url::{ParseError, Url};

/// A browser that ends when it is dropped.
pub struct Browser {
    driver: Child,
    /// What drives it.
    pub client: Client,
}

/// Where files go that a page offers. A browser that finds `..` in its path waits for ever.
///
/// # Panics
/// When the project's folder has gone.
pub fn downloads() -> PathBuf {
    project().canonicalize().expect("it is there").join("target/hil-out/downloads")
}

/// What axe finds on the page as it is: rules and the elements that break them.
pub const BROKEN_RULES: &str = "return axe.run(document, { resultTypes: ['violations'] }).then((found) =>
    found.violations.map((rule) => `${rule.id}: ${rule.nodes.map((node) => node.html).join(' ')}`))";

/// Deque's axe, out of the Python package that `.ci/run` installs.
///
/// # Panics
/// When it is not installed.
pub fn axe() -> String {
    let libraries = std::fs::read_dir(project().join("target/hil-venv/lib")).expect("installed");
    let scripts = libraries.map(|python| {
        let package = python.expect("readable").path().join("site-packages/axe_playwright_python");
        std::fs::read_to_string(package.join("axe.min.js"))
    });
    scripts.into_iter().find_map(Result::ok).expect("`.ci/run` installs axe-playwright-python")
}

/// Ask the browser for what its console says; Chromium only.
#[derive(Debug)]
struct ConsoleLog;

impl WebDriverCompatibleCommand for ConsoleLog {
    fn endpoint(&self, base: &Url, session: Option<&str>) -> Result<Url, ParseError> {
        base.join(&format!("session/{}/se/log", session.unwrap_or_default()))
    }

    fn method_and_body(&self, _: &Url) -> (Method, Option<String>) {
        (Method::POST, Some(json!({ "type": "browser" }).to_string()))
    }
}

impl Browser {
    /// Start one with a window of this size.
    ///
    /// # Panics
    /// When there is none: `.ci/run` installs it.
    pub async fn start([width, height]: [u32; 2]) -> Self {
        let free = TcpListener::bind("127.0.0.1:0").expect("a free port");
        let address = free.local_addr().expect("bound");
        drop(free);
        let driver = Command::new("chromedriver")
            .arg(format!("--port={}", address.port()))
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .expect("chromium-driver is installed");
        wait_for("the browser's driver", || TcpStream::connect(address).ok());
        let options = json!({
            "browserName": "chrome",
            "goog:loggingPrefs": { "browser": "ALL" },
            "goog:chromeOptions": { "args": [
                "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage",
                "--lang=en", format!("--window-size={width},{height}"),
            ], "prefs": { "download.default_directory": downloads() } },
        });
        let Value::Object(options) = options else { unreachable!("it is an object") };
        let client = ClientBuilder::new(HttpConnector::new())
            .capabilities(options)
            .connect(&format!("http://{address}"))
            .await
            .expect("the browser starts");
        Self { driver, client }
    }

    /// What a script returns.
    ///
    /// # Panics
    /// When the script fails.
    pub async fn run(&self, script: &str) -> Value {
        self.client.execute(script, Vec::new()).await.expect("the script runs")
    }

    /// Ask a script again and again until it returns something true.
    ///
    /// # Panics
    /// When it does not within a minute.
    pub async fn wait(&self, what: &str, script: &str) -> Value {
        for _ in 0..600 {
            let value = self.run(script).await;
            if !matches!(value, Value::Null | Value::Bool(false)) {
                return value;
            }
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
        panic!("waited a minute for {what}; the console: {:?}", self.console().await);
    }

    /// What the console has said since this was last asked.
    ///
    /// # Panics
    /// When the browser does not tell.
    pub async fn console(&self) -> Vec<String> {
        let log = self.client.issue_cmd(ConsoleLog).await.expect("the browser tells");
        let lines = log.as_array().cloned().unwrap_or_default();
        lines.iter().map(|line| format!("{} {}", line["level"], line["message"])).collect()
    }

    /// Save what it shows.
    ///
    /// # Panics
    /// When it cannot be saved.
    pub async fn screenshot(&self, path: &Path) {
        let png = self.client.screenshot().await.expect("a picture");
        std::fs::write(path, png).expect("room");
    }

    /// End it.
    pub async fn end(self) {
        let _ = self.client.clone().close().await;
    }
}

impl Drop for Browser {
    fn drop(&mut self) {
        let _ = self.driver.kill();
        let _ = self.driver.wait();
    }
}
