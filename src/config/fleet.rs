//! `[fleet]`: the broker that many machines of a site report to.

use super::ranges;
use crate::error::{Error, Result};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::net::SocketAddr;
use std::path::PathBuf;

/// `[fleet]`: parcels, health and events to an MQTT 5 broker.
#[derive(Clone, Debug, Default, PartialEq, Eq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Fleet {
    /// The broker's address and port, in numbers; none given: no fleet.
    pub broker: Option<SocketAddr>,
    /// The site's name: topics begin with beltgauge/SITE/LANE.
    pub site: Option<String>,
    /// The lane's name, which no other machine of the site has.
    pub lane: Option<String>,
    /// File with the user's name in its first line and the password in its second, relative to the
    /// configuration file; none given: the broker asks for none.
    pub login_file: Option<PathBuf>,
    /// Certificates (PEM) that the broker's must be signed by, relative to the configuration file; none
    /// given: no TLS.
    pub ca_file: Option<PathBuf>,
    /// The name in the broker's certificate; none given: its address.
    pub tls_name: Option<String>,
}

/// Of site and lane.
const NAME_CHARACTERS_MAX: usize = 64;

impl Fleet {
    pub(super) fn check(&self) -> Result<()> {
        for (key, name) in [("fleet.site", &self.site), ("fleet.lane", &self.lane)] {
            match name {
                Some(name) if !is_name(name) => {
                    return Err(Error::configuration(format!("{key} = {name:?}"))
                        .allowed(format!(
                            "1 to {NAME_CHARACTERS_MAX} letters, digits, dots, hyphens and underscores"
                        ))
                        .remedy("it is a part of MQTT topics: write it as \"lane-3\""));
                }
                None if self.broker.is_some() => {
                    return Err(Error::configuration(format!(
                        "fleet.broker is set, but {key} is not"
                    ))
                    .allowed("a name of its own for every machine: beltgauge/SITE/LANE")
                    .remedy(format!("set {key}, or leave fleet.broker out")));
                }
                _ => {}
            }
        }
        if let Some(broker) = self.broker {
            ranges::other_machine("fleet.broker", broker, "192.168.1.5:1883")?;
        }
        if self.tls_name.is_some() && self.ca_file.is_none() {
            return Err(Error::configuration("fleet.tls_name is set, but fleet.ca_file is not")
                .allowed("a name in the broker's certificate, which fleet.ca_file is to check")
                .remedy("set fleet.ca_file, or leave fleet.tls_name out"));
        }
        Ok(())
    }
}

fn is_name(name: &str) -> bool {
    (1..=NAME_CHARACTERS_MAX).contains(&name.len())
        && name.bytes().all(|b| b.is_ascii_alphanumeric() || b"-._".contains(&b))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn checked(text: &str) -> std::result::Result<Fleet, String> {
        let fleet: Fleet = toml::from_str(text).map_err(|e| e.to_string())?;
        fleet.check().map_err(|e| e.to_string()).map(|()| fleet)
    }

    #[test]
    fn a_fleet_needs_names_that_topics_can_have() {
        assert_eq!(checked(""), Ok(Fleet::default()));
        let whole = "broker = \"192.168.1.5:1883\"\nsite = \"hall_1\"\nlane = \"lane-3.b\"\n";
        assert!(checked(whole).is_ok());
        assert!(checked(&whole.replace("192.168.1.5", "[fd00::5]")).is_ok());
        for (wrong, part) in [
            (whole.replace("lane-3.b", "lane/3"), "fleet.lane = \"lane/3\""),
            (whole.replace("hall_1", "#"), "fleet.site = \"#\""),
            (whole.replace("hall_1", "+"), "fleet.site = \"+\""),
            (whole.replace("hall_1", ""), "fleet.site = \"\""),
            (whole.replace("lane = \"lane-3.b\"", ""), "fleet.lane is not"),
            (whole.replace(":1883", ":0"), "fleet.broker"),
            (whole.replace("192.168.1.5", "0.0.0.0"), "fleet.broker"),
            (whole.replace("192.168.1.5", "broker.example.com"), "socket address"),
            (format!("{whole}tls_name = \"b\""), "fleet.ca_file"),
            (format!("{whole}password = \"b\""), "unknown field"),
        ] {
            let error = checked(&wrong).expect_err(&wrong);
            assert!(error.contains(part), "{wrong}: {error}");
        }
    }
}
