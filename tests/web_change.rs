//! The site, changed through the page, by whoever has signed in and by nobody else.

mod common;

use beltgauge::config::Web;
use beltgauge::run::Keeper;
use beltgauge::sandbox;
use beltgauge::store::Store;
use beltgauge::web;
use common::page::{PATIENCE, Server, Still, body, status};
use common::{scratch, write_site};
use minisign::KeyPair;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// After a wrong code.
const PAUSE: Duration = Duration::from_millis(500);

/// A machine with a site in force, and its page.
struct Machine {
    store: Store,
    keeper: Arc<Keeper>,
    end: Arc<AtomicBool>,
    server: Server,
    site: PathBuf,
}

/// What a browser has once its visitor has signed in.
struct Visitor {
    cookie: String,
    token: String,
}

impl Machine {
    fn new(name: &str) -> Self {
        sandbox::use_program(PathBuf::from(env!("CARGO_BIN_EXE_beltgauge")));
        let root = scratch(name);
        let site = root.join("stick/beltgauge");
        std::fs::create_dir_all(&site).expect("room");
        write_site(&site, [320, 240]);
        let store = Store::new(&root.join("store"));
        beltgauge::run::import::import(&root.join("stick"), &store).expect("a valid site");
        let end = Arc::<AtomicBool>::default();
        let (keeper, server) = Self::start(&store, &end);
        Self { store, keeper, end, server, site }
    }

    fn start(store: &Store, end: &Arc<AtomicBool>) -> (Arc<Keeper>, Server) {
        let keeper = Keeper::new(store.clone(), Arc::clone(end)).expect("room");
        let keeper = Arc::new(keeper);
        let kept: Arc<dyn web::Keeper> = keeper.clone();
        (keeper, Server::kept(Web::default(), Arc::new(Still), Some(kept)))
    }

    fn ask(&self, method: &str, path: &str, headers: &str, body: &[u8]) -> String {
        let length = body.len();
        let head = format!(
            "{method} {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\
             Content-Length: {length}\r\n{headers}\r\n"
        );
        self.server.send(&[head.as_bytes(), body].concat())
    }

    fn sign_in(&self, code: &str) -> String {
        self.ask("POST", "/api/session", "Origin: http://localhost\r\n", code.as_bytes())
    }

    fn visitor(&self) -> Visitor {
        let answer = self.sign_in(&self.store.code().expect("kept"));
        assert_eq!(status(&answer), 200, "{answer}");
        let cookie = answer.lines().find_map(|line| line.strip_prefix("set-cookie: "));
        let cookie = cookie.expect("a cookie").to_owned();
        assert!(cookie.contains("; HttpOnly; SameSite=Strict"), "{cookie}");
        let cookie = cookie.split(';').next().expect("a pair").to_owned();
        Visitor { cookie, token: body(&answer)["token"].as_str().expect("a token").to_owned() }
    }

    /// Ask as the page does.
    fn ask_as(&self, visitor: &Visitor, method: &str, path: &str, body: &[u8]) -> String {
        let Visitor { cookie, token } = visitor;
        let headers = format!(
            "Origin: http://localhost\r\nCookie: other=1; {cookie}\r\nX-Beltgauge-Token: {token}\r\n"
        );
        self.ask(method, path, &headers, body)
    }

    fn site(&self, visitor: &Visitor) -> serde_json::Value {
        body(&self.ask_as(visitor, "GET", "/api/site", b""))
    }

    /// Have a change done; how it ended, and its report.
    fn change(&self, visitor: &Visitor, change: &str) -> (String, String) {
        let path = format!("/api/site/{change}");
        assert_eq!(status(&self.ask_as(visitor, "POST", &path, b"")), 202);
        let start = Instant::now();
        loop {
            let work = self.site(visitor)["work"].clone();
            let text = |key: &str| work[key].as_str().expect("a text").to_owned();
            if text("state") != "busy" {
                return (text("state"), text("report"));
            }
            assert!(start.elapsed() < PATIENCE, "it does not end");
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// Bring a configuration with another speed.
    fn bring(&self, visitor: &Visitor, from: &str, to: &str) {
        let text = std::fs::read_to_string(self.site.join("beltgauge.toml")).expect("there");
        assert!(text.contains(from), "{from}");
        let text = text.replace(from, to);
        assert_eq!(status(&self.ask_as(visitor, "POST", "/api/tray", b"")), 204);
        let put = self.ask_as(visitor, "PUT", "/api/tray/beltgauge.toml", text.as_bytes());
        assert_eq!(status(&put), 204, "{put}");
    }

    fn in_force(&self) -> String {
        std::fs::read_to_string(self.store.config()).expect("there")
    }
}

#[test]
fn who_has_signed_in_checks_changes_and_takes_back() {
    let machine = Machine::new("change-all");
    let visitor = machine.visitor();
    let site = machine.site(&visitor);
    assert_eq!(site["configuration"], machine.in_force());
    assert_eq!(site["camera"]["name"], "camera.toml");
    assert_eq!((&site["can_go_back"], &site["imports"]), (&false.into(), &1.into()));
    machine.bring(&visitor, "= 500", "= 800");
    let (state, report) = machine.change(&visitor, "check");
    assert_eq!(state, "good", "{report}");
    assert!(report.contains("It would be taken") && report.contains("320 x 240 px"), "{report}");
    assert!(machine.in_force().contains("= 500"), "nothing is changed by a check");
    assert_eq!(machine.site(&visitor)["imports"], 1);
    let (state, report) = machine.change(&visitor, "apply");
    assert_eq!(state, "good", "{report}");
    assert!(machine.in_force().contains("= 800"), "{report}");
    let start = Instant::now();
    while !machine.end.load(Ordering::Relaxed) {
        assert!(start.elapsed() < PATIENCE, "the program is to start again");
        std::thread::sleep(Duration::from_millis(20));
    }
    assert_eq!(machine.change(&visitor, "back").0, "good");
    assert!(machine.in_force().contains("= 500"));
    assert_eq!(machine.site(&visitor)["imports"], 3);
    let told: Vec<&str> = machine.server.board.take_notes().iter().map(|e| e.kind).collect();
    assert_eq!(told, ["signed_in", "site_check", "site_apply", "site_go_back"]);
}

#[test]
fn what_is_wrong_is_told_as_a_stick_would_be_and_changes_nothing() {
    let machine = Machine::new("change-wrong");
    let visitor = machine.visitor();
    for (from, to, word) in [
        ("= 500", "= <script>", "beltgauge.toml"),
        ("= -300", "= -90000", "zone.x_min_mm"),
        ("\"camera.toml\"", "\"/etc/passwd\"", "camera.calibration"),
        ("[belt]", "[plc]\nstate_file = \"/tmp/x\"\n[belt]", "plc.state_file"),
    ] {
        machine.bring(&visitor, from, to);
        for change in ["check", "apply"] {
            let (state, report) = machine.change(&visitor, change);
            assert!(state == "bad" && report.contains(word), "{change} {to}: {report}");
        }
    }
    assert_eq!(status(&machine.ask_as(&visitor, "POST", "/api/tray", b"")), 204);
    let (state, report) = machine.change(&visitor, "apply");
    assert!(state == "bad" && report.contains("there is no file beltgauge.toml"), "{report}");
    assert_eq!(machine.change(&visitor, "back").0, "bad", "there is none before it");
    assert!(machine.in_force().contains("= 500"));
    assert!(!machine.end.load(Ordering::Relaxed), "no reason to start again");
}

#[test]
fn nobody_else_changes_anything() {
    let machine = Machine::new("change-strangers");
    let visitor = machine.visitor();
    let Visitor { cookie, token } = &visitor;
    let own = "Origin: http://localhost\r\n";
    let (cookie, token) =
        (format!("Cookie: {cookie}\r\n"), format!("X-Beltgauge-Token: {token}\r\n"));
    let evil = "Origin: http://evil.example.com\r\n";
    let guessed = "Cookie: beltgauge=00\r\n";
    for (method, path) in [
        ("POST", "/api/tray"),
        ("PUT", "/api/tray/beltgauge.toml"),
        ("PUT", "/api/tray/lens/1.pgm"),
        ("POST", "/api/site/apply"),
        ("POST", "/api/site/back"),
        ("DELETE", "/api/session"),
    ] {
        for (headers, expected) in [
            (String::new(), 403),
            (own.to_owned(), 401),
            (format!("{own}{token}"), 401),
            (format!("{own}{guessed}{token}"), 401),
            (format!("{own}{cookie}"), 403),
            (format!("{own}{cookie}X-Beltgauge-Token: 00\r\n"), 403),
            (format!("{cookie}{token}"), 403),
            (format!("{evil}{cookie}{token}"), 403),
            (format!("Origin: null\r\n{cookie}{token}"), 403),
        ] {
            let answer = machine.ask(method, path, &headers, b"");
            assert_eq!(status(&answer), expected, "{method} {path} {headers:?}");
        }
    }
    for headers in [String::new(), own.to_owned(), cookie.clone()] {
        let answer = machine.ask("GET", "/api/site", &headers, b"");
        assert!(status(&answer) >= 400 && !answer.contains("speed"), "{headers:?}");
    }
    let stranger = body(&machine.server.get("/api/session"));
    assert_eq!(stranger, serde_json::json!({ "can_be_changed": true, "token": null }));
    assert_eq!(machine.site(&visitor)["imports"], 1);
    assert!(machine.in_force().contains("= 500"));
}

#[test]
fn a_machine_that_runs_with_a_file_is_changed_by_nobody() {
    let server = Server::start();
    assert_eq!(body(&server.get("/api/session"))["can_be_changed"], false);
    let request = "POST /api/session HTTP/1.1\r\nHost: localhost\r\nOrigin: http://localhost\r\n\
                   Connection: close\r\nContent-Length: 0\r\n\r\n";
    assert_eq!(status(&server.send(request.as_bytes())), 405);
}

#[test]
fn a_code_is_used_up_and_guessing_is_slow_however_many_guess() {
    const GUESSES: u32 = 6;
    let machine = Machine::new("change-guesses");
    let code = machine.store.code().expect("kept");
    let start = Instant::now();
    std::thread::scope(|scope| {
        for _ in 0..GUESSES {
            scope.spawn(|| assert_eq!(status(&machine.sign_in("00000-00000")), 403));
        }
    });
    assert!(start.elapsed() >= (GUESSES - 1) * PAUSE, "one after the other");
    let long = "0".repeat(100_000);
    assert_eq!(status(&machine.sign_in(&long)), 403);
    // A cookie that somebody else has put there beforehand becomes nobody's.
    let headers = "Origin: http://localhost\r\nCookie: beltgauge=planted\r\n";
    let answer = machine.ask("POST", "/api/session", headers, code.as_bytes());
    assert_eq!(status(&answer), 200);
    assert!(!answer.contains("planted"));
    let planted = machine.ask("GET", "/api/session", "Cookie: beltgauge=planted\r\n", b"");
    assert!(body(&planted)["token"].is_null());
    assert_eq!(status(&machine.sign_in(&code)), 403, "it is used up");
}

#[test]
fn who_guesses_and_hangs_up_makes_the_next_wait_all_the_same() {
    let machine = Machine::new("change-hang-up");
    let code = machine.store.code().expect("kept");
    let mut guess = machine.server.connect();
    let request = "POST /api/session HTTP/1.1\r\nHost: localhost\r\nOrigin: http://localhost\r\n\
                   Content-Length: 1\r\n\r\n0";
    guess.write_all(request.as_bytes()).expect("open");
    // It was tried by then; a right one is answered at once.
    std::thread::sleep(PAUSE / 5);
    drop(guess);
    let start = Instant::now();
    assert_eq!(status(&machine.sign_in(&code)), 200);
    assert!(start.elapsed() >= PAUSE / 2, "{:?}", start.elapsed());
}

#[test]
fn one_is_signed_in_at_a_time_also_when_the_program_starts_again() {
    let machine = Machine::new("change-session");
    let first = machine.visitor();
    let second = machine.visitor();
    let is_in = |machine: &Machine, visitor: &Visitor| {
        status(&machine.ask_as(visitor, "GET", "/api/site", b"")) == 200
    };
    assert!(!is_in(&machine, &first) && is_in(&machine, &second));
    let (keeper, server) = Machine::start(&machine.store, &machine.end);
    let machine = Machine { keeper, server, ..machine };
    assert!(!is_in(&machine, &first) && is_in(&machine, &second));
    assert_eq!(status(&machine.ask_as(&second, "DELETE", "/api/session", b"")), 204);
    assert!(!is_in(&machine, &second));
    let (keeper, server) = Machine::start(&machine.store, &machine.end);
    let machine = Machine { keeper, server, ..machine };
    assert!(!is_in(&machine, &second), "signed out for good");
}

#[test]
fn only_plain_names_and_so_much_are_taken() {
    let machine = Machine::new("change-names");
    let visitor = machine.visitor();
    let put = |path: &str, bytes: &[u8]| status(&machine.ask_as(&visitor, "PUT", path, bytes));
    assert_eq!(status(&machine.ask_as(&visitor, "POST", "/api/tray", b"")), 204);
    for name in ["a.toml", "lens/1.pgm", "belt/1.pgm", "%61b"] {
        assert_eq!(put(&format!("/api/tray/{name}"), b"x"), 204, "{name}");
    }
    let long = "a".repeat(101);
    for name in [
        "..%2Fx",
        "%2E%2E%2Fx",
        "..",
        "%2e%2e",
        "lens/..",
        "lens/..%2F..%2Fx",
        "lens/.x",
        ".x",
        "other/1.pgm",
        "%2Fetc%2Fpasswd",
        "lens%2F..%2Fx",
        "a%00b",
        &long,
        "lens/",
        "",
    ] {
        let code = put(&format!("/api/tray/{name}"), b"x");
        assert!((400..500).contains(&code), "{name}: {code}");
    }
    // Nothing was put beside the tray.
    let report = machine.change(&visitor, "check").1;
    assert!(report.contains("error"), "{report}");
    for (from, expected) in [(32 << 20, 204), ((32 << 20) + 1, 413)] {
        assert_eq!(put("/api/tray/lens/large.pgm", &vec![0; from]), expected, "{from}");
    }
    let mut taken = 0;
    while put(&format!("/api/tray/belt/{taken}.pgm"), b"x") == 204 {
        taken += 1;
        assert!(taken < 1000, "there is an end to it");
    }
    assert!(taken > 100);
    // An empty tray has room again.
    assert_eq!(status(&machine.ask_as(&visitor, "POST", "/api/tray", b"")), 204);
    for still in 0..4 {
        let path = format!("/api/tray/lens/{still}.pgm");
        assert_eq!(put(&path, &vec![0; 32 << 20]), 204);
    }
    assert_eq!(put("/api/tray/lens/5.pgm", &vec![0; 32 << 20]), 409, "too much together");
}

#[test]
fn with_a_key_in_force_the_page_brings_nothing_unsigned() {
    let machine = Machine::new("change-signed");
    let key = KeyPair::generate_unencrypted_keypair().expect("random").pk.to_base64();
    let visitor = machine.visitor();
    let import = format!("[import]\npublic_key = \"{key}\"\n[belt]");
    machine.bring(&visitor, "[belt]", &import);
    assert_eq!(machine.change(&visitor, "apply").0, "good");
    machine.bring(&visitor, "= 500", "= 800");
    for change in ["check", "apply"] {
        let (state, report) = machine.change(&visitor, change);
        assert!(state == "bad" && report.contains("not signed"), "{change}: {report}");
    }
    assert!(machine.in_force().contains("= 500"));
}

#[test]
fn the_code_is_left_on_a_stick_that_was_taken_and_its_file_is_private() {
    use std::os::unix::fs::PermissionsExt;
    let machine = Machine::new("change-code");
    let code = machine.store.code().expect("kept");
    let left = std::fs::read_to_string(machine.site.join("code.txt")).expect("left");
    assert!(left.contains(&code), "{left}");
    let is_elsewhere =
        |path: &Path| std::fs::read_to_string(path).is_ok_and(|text| text.contains(&code));
    assert!(!is_elsewhere(&machine.site.join("report.txt")), "others read it");
    let file = machine.store.root().join("access.toml");
    let mode = std::fs::metadata(&file).expect("kept").permissions().mode();
    assert_eq!(mode & 0o077, 0);
    let printed =
        common::run(common::beltgauge().args(["code", "--store"]).arg(machine.store.root()));
    assert_eq!(String::from_utf8_lossy(&printed.stdout).trim(), code);
    // A stick that is refused brings nobody in.
    std::fs::write(machine.site.join("beltgauge.toml"), "nonsense").expect("room");
    std::fs::remove_file(machine.site.join("code.txt")).expect("there");
    let stick = machine.site.parent().expect("the stick");
    assert!(beltgauge::run::import::import(stick, &machine.store).is_err());
    assert!(!machine.site.join("code.txt").exists());
    // It runs as long as its machine is tested.
    drop(machine.keeper);
}
