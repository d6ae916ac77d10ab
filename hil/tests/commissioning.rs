//! A camera is set up and calibrated by the page alone, and the site changed, as a technician does with a
//! browser. Screenshots are in `target/hil-out/web-setup`.

use beltgauge::camera::{Camera, CameraFile};
use beltgauge::run::demo;
use fantoccini::Locator;
use hil::Demo;
use hil::browser::{BROKEN_RULES, Browser, axe, downloads};
use serde_json::json;
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

/// Frames a second of the demo.
const FPS: u32 = 30;

/// Choose what stills are kept for.
async fn keep_stills(browser: &Browser, folder: &str) {
    browser
        .run(&format!(
            "const choice = document.querySelector('main select'); choice.value = '{folder}';
             choice.dispatchEvent(new Event('change'))"
        ))
        .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_camera_is_set_up_by_the_page_and_its_stills_calibrate_it() {
    let demo = Demo::start_with("web-setup", 600, false, &["--board"]);
    let _ = std::fs::remove_dir_all(downloads());
    let browser = Browser::start([1400, 1100]).await;
    browser.client.goto(&format!("http://{}/#setup", demo.page)).await.expect("it opens");
    let frame = "return document.getElementById('setup')?.dataset.frame ?? null";
    browser.wait("a picture", frame).await;
    // Somewhere in it the board is, with sharp edges: the demo's camera blurs by half a pixel.
    let best = "return [...document.querySelectorAll('.places figcaption b')]
        .map((figure) => parseFloat(figure.textContent)).find((blur) => blur < 0.8) ?? null";
    browser.wait("a sharp place", best).await;

    // With nothing asked for nothing is kept.
    // It is known once the browser has opened its store, which a picture may forestall: no number until then.
    let kept = "Number(document.querySelector('[data-stills]')?.dataset.stills ?? NaN)";
    browser.wait("the count of stills", &format!("return !isNaN({kept})")).await;
    assert_eq!(browser.run(&format!("return {kept}")).await, json!(0));
    keep_stills(&browser, "lens").await;
    // Each is shown for a second; those of the board on the belt serve as well.
    browser.wait("stills of the lens", &format!("return {kept} >= 12")).await;
    browser.screenshot(&demo.out.join("setup.png")).await;
    // They survive that the page is loaded again.
    browser.client.refresh().await.expect("it opens again");
    browser.wait("a picture", frame).await;
    keep_stills(&browser, "lens").await;
    browser.wait("the same stills", &format!("return {kept} >= 12")).await;
    keep_stills(&browser, "belt").await;
    // Only where somebody says so: after 15 that are held come four where the belt has carried it.
    for place in 0..4 {
        let there = format!(
            "const frame = Number(document.getElementById('setup').dataset.frame);
             return Math.floor(frame / {FPS}) % 19 === {} && frame % {FPS} < {FPS} / 2",
            15 + place
        );
        browser.wait("the board on the belt", &there).await;
        browser.run("document.getElementById('board-keep').click()").await;
        let taken = format!("return {kept} === {}", place + 1);
        browser.wait("a still of the belt", &taken).await;
    }
    browser.screenshot(&demo.out.join("setup-belt.png")).await;
    // A click of a person: no file is taken from a page that offers it by itself.
    let save = browser.client.find(Locator::Id("board-save")).await.expect("a button");
    save.click().await.expect("clicked");
    let file = downloads().join("beltgauge-stills.tar");
    hil::wait_for("the download", || file.exists().then_some(()));
    let console = browser.console().await;
    assert!(console.is_empty(), "{console:#?}");

    // As a technician at a computer: the archive is a folder that `calibrate` takes.
    let status = Command::new("tar").arg("-xf").arg(&file).arg("-C").arg(downloads()).status();
    assert!(status.expect("tar is installed").success());
    let stick = downloads().join("beltgauge");
    let settings = std::fs::read_to_string(stick.join("calibration.toml")).expect("it is there");
    assert!(settings.starts_with("board = [9, 6]\nsquare_mm = 25\n"), "{settings}");
    let calibrate = |what: &str, more: &[&str]| {
        let calibrated = Command::new(hil::beltgauge())
            .args(["calibrate", what])
            .arg(stick.join(what))
            .args(["--board", "9x6", "--square-mm", "25"])
            .args(more)
            .current_dir(&stick)
            .output()
            .expect("it runs");
        let words = String::from_utf8_lossy(&calibrated.stdout).into_owned();
        println!("{words}");
        let error = String::from_utf8_lossy(&calibrated.stderr);
        assert!(calibrated.status.success(), "{words}{error}");
    };
    calibrate("lens", &["--out", "lens.toml"]);
    calibrate(
        "belt",
        &["--board-thickness-mm", "3", "--lens", "lens.toml", "--out", "camera.toml"],
    );

    let truth = demo::scenario().and_then(|scenario| scenario.camera()).expect("committed");
    let by_command = stick.join("camera.toml");
    is_the_camera(&CameraFile::load(&by_command).expect("written"), &truth);
    // And by the machine itself, which has the same figures from the same stills.
    let by_page = calibrated_by_the_page(&browser, &file, &truth).await;
    assert_eq!(by_page, std::fs::read_to_string(by_command).expect("written"));
    browser.end().await;
}

/// The demo's camera, within what the reports say of themselves (three sigmas: 0.6 px and 1.5 mm).
fn is_the_camera(camera: &Camera, truth: &Camera) {
    let off = |i: usize| camera.lens.parameters()[i] - truth.lens.parameters()[i];
    let lens_off_px = [0, 1, 2, 3].map(off);
    assert!(lens_off_px.iter().all(|px| px.abs() < 0.6), "{lens_off_px:?}");
    let height_off_mm = camera.centre_in_belt().z - truth.centre_in_belt().z;
    assert!(height_off_mm.abs() < 1.5, "{height_off_mm}");
}

/// A machine that runs with a store, without a camera; the test starts it again, as an appliance's init does.
struct Machine {
    store: PathBuf,
    page: String,
    child: Child,
}

impl Machine {
    /// With a camera file that is far from right, and markup in its configuration.
    fn new(out: &Path, truth: &Camera) -> Self {
        let free = [(); 2].map(|()| TcpListener::bind("127.0.0.1:0").expect("a free port"));
        let [modbus, page] = free.each_ref().map(|socket| socket.local_addr().expect("bound"));
        drop(free);
        let (stick, store) = (out.join("stick"), out.join("store"));
        std::fs::create_dir_all(stick.join("beltgauge")).expect("room");
        // By no means the camera's.
        let [width, height] = truth.image_size_px;
        let wrong = format!(
            "image_size_px = [{width}, {height}]\n[lens]\nmodel = \"brown\"\nfx_px = 900\nfy_px = 900\n\
             cx_px = {}\ncy_px = {}\ndistortion = [0, 0, 0, 0, 0]\n[pose]\n\
             rotation = [[1, 0, 0], [0, -1, 0], [0, 0, -1]]\ntranslation_mm = [0, 0, 1700]\n",
            width / 2,
            height / 2
        );
        let config = format!(
            "# <img class='strange' src='x'>\n[camera]\ncalibration = \"camera.toml\"\n\
             interface = \"gige\"\ndevice = \"127.0.0.1\"\n[belt]\nspeed_mm_per_s = 500\n\
             [zone]\nx_min_mm = -300\nx_max_mm = 300\ny_min_mm = -200\ny_max_mm = 200\n\
             [modbus]\nlisten = \"{modbus}\"\n\
             [web]\naddress = \"127.0.0.1\"\nport = {}\n",
            page.port()
        );
        std::fs::write(stick.join("beltgauge/camera.toml"), wrong).expect("room");
        std::fs::write(stick.join("beltgauge/beltgauge.toml"), config).expect("room");
        let mut import = Command::new(hil::beltgauge());
        let imported = import.arg("import").arg(&stick).arg("--store").arg(&store).output();
        let imported = imported.expect("it runs");
        let error = String::from_utf8_lossy(&imported.stderr);
        assert!(imported.status.success(), "{error}");
        let child = Self::start(&store);
        Self { store, page: format!("http://{page}/"), child }
    }

    fn start(store: &Path) -> Child {
        Command::new(hil::beltgauge())
            .args(["run", "--store"])
            .arg(store)
            .stderr(Stdio::null())
            .spawn()
            .expect("it starts")
    }

    /// It ends by itself when another site is in force.
    fn is_started_again(&mut self) {
        let ended = hil::wait_for("its end", || self.child.try_wait().expect("a child"));
        assert!(ended.success());
        self.child = Self::start(&self.store);
    }

    fn code(&self) -> String {
        let mut command = Command::new(hil::beltgauge());
        let told = command.args(["code", "--store"]).arg(&self.store).output().expect("it runs");
        String::from_utf8_lossy(&told.stdout).trim().to_owned()
    }

    fn config(&self) -> String {
        std::fs::read_to_string(self.store.join("current/beltgauge.toml")).expect("in force")
    }
}

impl Drop for Machine {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Confirm the dialog, wait until the program has started again.
async fn confirm(browser: &Browser, machine: &mut Machine) {
    browser.wait("the dialog", "return document.getElementById('dialog').open").await;
    browser.run("document.getElementById('site-confirm').click()").await;
    machine.is_started_again();
}

/// Bring the saved stills to a machine, sign in, calibrate; then change its configuration and go back.
/// Returns the camera file that came of it.
async fn calibrated_by_the_page(browser: &Browser, stills: &Path, truth: &Camera) -> String {
    let out = hil::project().join("target/hil-out/web-setup");
    let mut machine = Machine::new(&out, truth);
    let opened = || async { browser.client.goto(&format!("{}#site", machine.page)).await.is_ok() };
    for _ in 0..100 {
        if opened().await {
            break;
        }
        tokio::time::sleep(std::time::Duration::from_millis(100)).await;
    }
    browser.wait("a place for the code", "return document.getElementById('code') !== null").await;
    browser.run(&axe()).await;
    assert_eq!(browser.run(BROKEN_RULES).await, json!([]), "before somebody signs in");
    browser.screenshot(&out.join("site-code.png")).await;
    let code = browser.client.find(Locator::Id("code")).await.expect("a field");
    code.send_keys(&format!("{}\n", machine.code().to_lowercase())).await.expect("typed");
    let editor = "return document.getElementById('configuration') !== null";
    browser.wait("the configuration", editor).await;
    assert_eq!(browser.run(BROKEN_RULES).await, json!([]), "signed in");
    let text = browser.run("return document.getElementById('configuration').value").await;
    assert_eq!(text, machine.config());
    assert_eq!(browser.run("return document.querySelectorAll('.strange').length").await, 0);

    let file = browser.client.find(Locator::Id("site-restore")).await.expect("a field");
    file.send_keys(&stills.to_string_lossy()).await.expect("chosen");
    confirm(browser, &mut machine).await;
    // Signed in all the same.
    let calibrated = "return document.getElementById('report')?.textContent.includes('is in force')
        && !document.getElementById('site-back').disabled && !document.getElementById('site-check').disabled";
    browser.wait("the report", calibrated).await;
    browser.screenshot(&out.join("site.png")).await;
    let camera = std::fs::read_to_string(machine.store.join("current/camera.toml"));
    let camera = camera.expect("in force");

    let typed = |from: &str, to: &str| {
        format!(
            "const text = document.getElementById('configuration');
             text.value = text.value.replace('{from}', '{to}')"
        )
    };
    browser.run(&typed("= 500", "= 5")).await;
    browser.run("document.getElementById('site-check').click()").await;
    let refused =
        "return document.getElementById('report').textContent.includes('belt.speed_mm_per_s = 5')
        && !document.getElementById('site-check').disabled";
    browser.wait("why not", refused).await;
    browser.run(&typed("= 5\\n", "= 600\\n")).await;
    browser.run("document.getElementById('site-apply').click()").await;
    browser.wait("the dialog", "return document.getElementById('dialog').open").await;
    let difference = "return [...document.querySelectorAll('.added, .removed')]
        .map((line) => line.textContent.trim())";
    let lines = ["- speed_mm_per_s = 500", "+ speed_mm_per_s = 600"];
    assert_eq!(browser.run(difference).await, json!(lines));
    browser.screenshot(&out.join("site-difference.png")).await;
    confirm(browser, &mut machine).await;
    let of = |speed| {
        format!(
            "return document.getElementById('configuration')?.value.includes('= {speed}')
                && !document.getElementById('site-check').disabled"
        )
    };
    browser.wait("the new speed", &of(600)).await;
    assert!(machine.config().contains("= 600"));
    browser.run("document.getElementById('site-back').click()").await;
    confirm(browser, &mut machine).await;
    browser.wait("the old speed", &of(500)).await;
    assert!(machine.config().contains("= 500"));
    // Who did what is an event.
    browser.run("location.hash = '#events'").await;
    let told = "return document.querySelector('tbody')?.textContent.includes('Started')";
    browser.wait("events", told).await;
    camera
}
