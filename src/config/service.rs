//! The tables of what people see: the web page, the archive behind it, and the log.

use super::ranges;
use crate::error::{Error, Result};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::path::PathBuf;

/// `[web]`: the page for people, and figures for machines.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Web {
    /// Serve it.
    pub enabled: bool,
    /// Address of this machine that it is served at; 0.0.0.0: all of them.
    pub address: IpAddr,
    /// Its port.
    pub port: u16,
    /// Only these addresses may see it; none given: all.
    pub allow: Vec<IpAddr>,
    /// Names that browsers may call this machine by, besides its own, `localhost` and any address.
    pub hosts: Vec<String>,
    /// Connections at once; a browser opens up to six.
    pub connections_max: usize,
    /// Live pictures a second, whoever and how many look.
    pub pictures_per_s_max: u32,
}

impl Default for Web {
    fn default() -> Self {
        Self {
            enabled: true,
            address: IpAddr::V4(Ipv4Addr::UNSPECIFIED),
            port: 8080,
            allow: Vec::new(),
            hosts: Vec::new(),
            connections_max: 64,
            pictures_per_s_max: 10,
        }
    }
}

/// `[archive]`: parcels with their pictures, and events, on the disk.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Archive {
    /// Its folder, relative to the configuration file; none given: the store's, or none.
    pub folder: Option<PathBuf>,
    /// It takes no more of the disk; the oldest goes first.
    pub mib_max: usize,
}

impl Default for Archive {
    fn default() -> Self {
        Self { folder: None, mib_max: 2048 }
    }
}

/// `[log]`: a copy of the log for a site's collector.
#[derive(Clone, Debug, Default, PartialEq, Eq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Log {
    /// Address and port of a syslog server (RFC 5424 over UDP), in numbers; none given: none.
    pub syslog: Option<SocketAddr>,
}

impl Log {
    pub(super) fn check(&self) -> Result<()> {
        self.syslog.map_or(Ok(()), |to| ranges::other_machine("log.syslog", to, "192.168.1.5:514"))
    }
}

/// The longest name that the domain name system has.
const HOST_CHARACTERS_MAX: usize = 253;

impl Web {
    /// Whether a visitor may see the page. An IPv4 visitor of an IPv6 socket is the same visitor.
    pub fn admits(&self, visitor: IpAddr) -> bool {
        let is = |a: &IpAddr| a.to_canonical() == visitor.to_canonical();
        self.allow.is_empty() || self.allow.iter().any(is)
    }

    pub(super) fn check(&self) -> Result<()> {
        let is_name = |host: &&String| {
            (1..=HOST_CHARACTERS_MAX).contains(&host.len())
                && host.bytes().all(|b| b.is_ascii_alphanumeric() || b"-._".contains(&b))
        };
        match self.hosts.iter().find(|host| !is_name(host)) {
            None => Ok(()),
            Some(host) => Err(Error::configuration(format!("web.hosts: {host:?}"))
                .allowed("names of letters, digits, dots and hyphens, without scheme and port")
                .remedy("write it as [\"lane3.example.com\"]")),
        }
    }
}
