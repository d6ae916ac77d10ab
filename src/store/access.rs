//! Who may change the store through the page: whoever brings the one-time code, for a shift at most.
//!
//! The code is random and of 50 bits, not chosen by a person: it needs no slow hash, and who guesses twice a
//! second has one chance in a million after ten years. It is used up by the first who brings it. Who has
//! signed in is known by a random secret, of which the store has the digest alone; it is good until the
//! machine starts anew, and survives that the program does.

use super::manifest::sha256;
use super::{Store, files};
use crate::error::{Error, Result};
use rustix::rand::{GetRandomFlags, getrandom};
use rustix::time::{ClockId, clock_gettime};
use serde::{Deserialize, Serialize};

pub(super) const ACCESS: &str = "access.toml";
/// Letters and digits that nobody takes for another (Crockford's base 32).
const ALPHABET: &[u8; 32] = b"0123456789ABCDEFGHJKMNPQRSTVWXYZ";
/// Digits of a code, of 5 bits each.
const CODE_DIGITS: usize = 10;
/// Random bytes of a secret.
const SECRET_BYTES: usize = 32;
/// Who has signed in must do so again after this.
const SHIFT_S: u64 = 8 * 3600;
/// Changes with every start of the machine.
const BOOT_ID: &str = "/proc/sys/kernel/random/boot_id";

/// `access.toml`.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct Access {
    /// The next one who brings it may change the store.
    code: String,
    session: Option<Session>,
}

/// Somebody who has signed in.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Session {
    secret_sha256: String,
    /// Which start of the machine it is of.
    boot: String,
    /// On the clock that counts from that start, also while the machine sleeps.
    until_s: u64,
}

impl Session {
    /// Whether it is of whoever has this secret, and not over.
    pub fn is_of(&self, secret: &str) -> bool {
        // Compared are digests: how long that takes tells nothing of the secret.
        self.secret_sha256 == sha256(secret.as_bytes())
            && self.boot == boot()
            && now_s() < self.until_s
    }
}

impl Store {
    /// The code that is good for signing in once. One is made if there is none.
    pub fn code(&self) -> Result<String> {
        if let Some(access) = self.access() {
            return Ok(access.code);
        }
        let access = Access { code: new_code()?, session: None };
        self.keep_access(&access)?;
        Ok(access.code)
    }

    /// Sign in with the code, which is used up: the secret that whoever brought it is known by. Whoever had
    /// signed in before is signed out. `None`: it is another code.
    pub fn sign_in(&self, code: &str) -> Result<Option<(String, Session)>> {
        if sha256(normal(code).as_bytes()) != sha256(normal(&self.code()?).as_bytes()) {
            return Ok(None);
        }
        let secret = sha256(&random::<SECRET_BYTES>()?);
        let until_s = now_s() + SHIFT_S;
        let session = Session { secret_sha256: sha256(secret.as_bytes()), boot: boot(), until_s };
        self.keep_access(&Access { code: new_code()?, session: Some(session.clone()) })?;
        Ok(Some((secret, session)))
    }

    /// Sign out whoever has signed in.
    pub fn sign_out(&self) -> Result<()> {
        let code = self.code()?;
        self.keep_access(&Access { code, session: None })
    }

    /// Who has signed in last.
    pub fn session(&self) -> Option<Session> {
        self.access()?.session
    }

    /// `None`: nothing is known, or not any more.
    fn access(&self) -> Option<Access> {
        let bytes = files::read(&self.root.join(ACCESS), super::TEXT_BYTES_MAX).ok()?;
        let access: Access = toml::from_str(std::str::from_utf8(&bytes).ok()?).ok()?;
        (normal(&access.code).len() == CODE_DIGITS).then_some(access)
    }

    fn keep_access(&self, access: &Access) -> Result<()> {
        std::fs::create_dir_all(&self.root).map_err(|e| self.failed(&e))?;
        let text = toml::to_string(access).map_err(std::io::Error::other);
        text.and_then(|text| files::replace_private(&self.root.join(ACCESS), text.as_bytes()))
            .map_err(|e| self.failed(&e))
    }
}

/// As a person writes it: small letters, strokes and spaces between them, O for 0.
fn normal(code: &str) -> String {
    let digit = |c: char| match c.to_ascii_uppercase() {
        'O' => Some('0'),
        'I' | 'L' => Some('1'),
        c => c.is_ascii_alphanumeric().then_some(c),
    };
    code.chars().filter_map(digit).collect()
}

fn new_code() -> Result<String> {
    let digits = random::<CODE_DIGITS>()?.map(|byte| char::from(ALPHABET[usize::from(byte % 32)]));
    let (first, second) = digits.split_at(CODE_DIGITS / 2);
    Ok(format!("{}-{}", first.iter().collect::<String>(), second.iter().collect::<String>()))
}

fn random<const N: usize>() -> Result<[u8; N]> {
    let mut bytes = [0; N];
    // The kernel gives up to 256 bytes whole.
    match getrandom(&mut bytes, GetRandomFlags::empty()) {
        Ok(n) if n == N => Ok(bytes),
        _ => Err(Error::failure("the kernel gives no random numbers")),
    }
}

fn boot() -> String {
    std::fs::read_to_string(BOOT_ID).unwrap_or_default().trim_end().to_owned()
}

fn now_s() -> u64 {
    clock_gettime(ClockId::Boottime).tv_sec as u64
}

#[cfg(test)]
mod tests {
    use super::*;

    fn store(name: &str) -> Store {
        let root =
            std::env::temp_dir().join(format!("beltgauge-access-{name}-{}", std::process::id()));
        let _ = std::fs::remove_dir_all(&root);
        Store::new(&root)
    }

    #[test]
    fn a_code_is_good_once_and_however_it_is_typed() {
        let store = store("once");
        let code = store.code().expect("room");
        assert_eq!(store.code().expect("room"), code, "until it is used");
        assert!(store.sign_in("00000-00000").expect("room").is_none());
        assert!(store.sign_in("").expect("room").is_none());
        let typed = format!(" {} ", code.to_lowercase().replace('-', " ").replace('0', "o"));
        let (secret, session) = store.sign_in(&typed).expect("room").expect("it is the code");
        assert!(session.is_of(&secret) && !session.is_of("another") && !session.is_of(""));
        assert!(store.sign_in(&code).expect("room").is_none(), "used up");
        let kept = store.session().expect("kept");
        assert!(kept.is_of(&secret), "the program may start anew");
        let text = std::fs::read_to_string(store.root.join(ACCESS)).expect("kept");
        assert!(!text.contains(&secret), "the store has its digest alone");
        let next = store.code().expect("room");
        let (other, session) = store.sign_in(&next).expect("room").expect("it is the code");
        assert!(session.is_of(&other) && !session.is_of(&secret), "one at a time");
        store.sign_out().expect("room");
        assert!(store.session().is_none());
    }

    #[test]
    fn a_session_ends_with_its_time_and_with_the_machines_start() {
        let store = store("ends");
        let code = store.code().expect("room");
        let (secret, session) = store.sign_in(&code).expect("room").expect("it is the code");
        let over = Session { until_s: now_s(), ..session.clone() };
        let before = Session { boot: "another".into(), ..session };
        assert!(!over.is_of(&secret) && !before.is_of(&secret));
    }

    #[test]
    fn what_is_damaged_gives_a_new_code_and_nobody_is_signed_in() {
        let store = store("damaged");
        let code = store.code().expect("room");
        for text in ["", "code = ", "code = \"\"", "code = \"---\""] {
            std::fs::write(store.root.join(ACCESS), text).expect("room");
            assert!(store.sign_in("").expect("room").is_none(), "{text}");
            assert!(store.session().is_none() && store.code().expect("room") != code);
        }
    }
}
