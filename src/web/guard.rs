//! Who may ask, and what browsers are told about what they get.

use crate::config::Web as Settings;
use axum::http::header::{self, HeaderName, HeaderValue};
use axum::http::{HeaderMap, Request, Uri};
use std::collections::HashMap;
use std::net::IpAddr;
use std::sync::{Arc, Mutex, PoisonError};

/// Nothing from elsewhere, no scripts in the page's text, in nobody's frame.
const CONTENT_SECURITY_POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; \
    img-src 'self' blob:; connect-src 'self'; base-uri 'none'; form-action 'none'; \
    frame-ancestors 'none'";
/// On every answer.
const HEADERS: [(HeaderName, &str); 6] = [
    (header::CONTENT_SECURITY_POLICY, CONTENT_SECURITY_POLICY),
    (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
    (header::X_FRAME_OPTIONS, "DENY"),
    (header::REFERRER_POLICY, "no-referrer"),
    (HeaderName::from_static("cross-origin-resource-policy"), "same-origin"),
    (header::CACHE_CONTROL, "no-store"),
];
/// Of all connections so many may be of one address: one visitor cannot lock out all others.
const SHARE_OF_ONE: usize = 2;

/// Put the headers on an answer.
pub(super) fn protect(headers: &mut HeaderMap) {
    for (name, value) in HEADERS {
        headers.insert(name, HeaderValue::from_static(value));
    }
}

/// The names that this machine may be called by. A browser that was led here under another one by a
/// stranger's page (DNS rebinding) gets nothing: that page could read it.
#[derive(Clone, Debug)]
pub(super) struct Hosts(Arc<[String]>);

impl Hosts {
    pub(super) fn new(settings: &Settings) -> Self {
        let own = rustix::system::uname().nodename().to_string_lossy().into_owned();
        let local = format!("{own}.local");
        let names = settings.hosts.iter().cloned().chain([own, local, "localhost".to_owned()]);
        Self(names.filter(|name| !name.is_empty()).collect())
    }

    /// Whether a request is for this machine.
    pub(super) fn admit<B>(&self, request: &Request<B>) -> bool {
        let mut hosts = request.headers().get_all(header::HOST).iter();
        let (Some(host), None) = (hosts.next(), hosts.next()) else { return false };
        let Some(host) = host.to_str().ok().and_then(|text| text.parse::<Uri>().ok()) else {
            return false;
        };
        let named = |uri: &Uri| uri.host().is_some_and(|name| self.is_ours(name));
        // A request line may name a host too.
        named(&host) && (request.uri().host().is_none() || named(request.uri()))
    }

    fn is_ours(&self, name: &str) -> bool {
        let name = name.trim_end_matches('.');
        let address = name.trim_start_matches('[').trim_end_matches(']');
        address.parse::<IpAddr>().is_ok()
            || self.0.iter().any(|ours| ours.eq_ignore_ascii_case(name))
    }
}

/// Counts connections.
#[derive(Clone, Debug)]
pub(super) struct Doorkeeper {
    most: usize,
    inside: Arc<Mutex<HashMap<IpAddr, usize>>>,
}

/// A connection that was let in; it leaves when this is dropped.
#[derive(Debug)]
pub(super) struct Visit {
    address: IpAddr,
    inside: Arc<Mutex<HashMap<IpAddr, usize>>>,
}

impl Doorkeeper {
    pub(super) fn new(most: usize) -> Self {
        Self { most, inside: Arc::default() }
    }

    /// Let one more in, if there is room.
    pub(super) fn admit(&self, address: IpAddr) -> Option<Visit> {
        let address = address.to_canonical();
        let mut inside = self.inside.lock().unwrap_or_else(PoisonError::into_inner);
        let all: usize = inside.values().sum();
        let of_one = inside.get(&address).copied().unwrap_or(0);
        if all >= self.most || of_one >= self.most / SHARE_OF_ONE {
            return None;
        }
        *inside.entry(address).or_default() += 1;
        Some(Visit { address, inside: Arc::clone(&self.inside) })
    }
}

impl Drop for Visit {
    fn drop(&mut self) {
        let mut inside = self.inside.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(count) = inside.get_mut(&self.address) {
            *count -= 1;
            if *count == 0 {
                inside.remove(&self.address);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn admits(request_line: &str, hosts: &[&str]) -> bool {
        let settings = Settings { hosts: vec!["lane3.example.com".into()], ..Settings::default() };
        let mut request = Request::builder().uri(request_line);
        for host in hosts {
            request = request.header("host", *host);
        }
        Hosts::new(&settings).admit(&request.body(()).expect("a request"))
    }

    #[test]
    fn the_machine_answers_to_its_addresses_and_names_only() {
        for host in [
            "192.168.1.50",
            "192.168.1.50:8080",
            "[fe80::1]:8080",
            "[::1]",
            "localhost:8080",
            "LOCALHOST",
            "lane3.example.com",
            "lane3.example.com.:8080",
        ] {
            assert!(admits("/", &[host]), "{host}");
        }
        for host in [
            "evil.example.com",
            "lane3.example.com.evil.com",
            "192.168.1.50.evil.com",
            "localhost@evil.com",
            "",
            "a b",
        ] {
            assert!(!admits("/", &[host]), "{host}");
        }
        assert!(!admits("/", &[]), "no name at all");
        assert!(!admits("/", &["localhost", "evil.example.com"]), "two names");
        assert!(!admits("http://evil.example.com/", &["localhost"]), "another in the request line");
        assert!(admits("http://localhost/", &["localhost"]));
    }

    #[test]
    fn one_address_cannot_take_all_places() {
        let door = Doorkeeper::new(8);
        let ip = |text: &str| text.parse::<IpAddr>().expect("an address");
        let greedy: Vec<_> = std::iter::from_fn(|| door.admit(ip("10.0.0.1"))).take(100).collect();
        assert_eq!(greedy.len(), 4);
        assert!(door.admit(ip("::ffff:10.0.0.1")).is_none(), "the same one");
        let others: Vec<_> =
            (2..20).filter_map(|i| door.admit(ip(&format!("10.0.0.{i}")))).collect();
        assert_eq!(others.len(), 4);
        drop(greedy);
        assert!(door.admit(ip("10.0.0.1")).is_some());
        drop(others);
        assert!(door.inside.lock().expect("whole").is_empty(), "nobody is remembered");
    }
}
