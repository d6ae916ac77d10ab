//! The way to the broker: TCP, and TLS 1.3 on it if the configuration names who signs.

use crate::config::Fleet as Settings;
use crate::error::{Error, Result};
use crate::store::files;
use std::net::SocketAddr;
use std::path::Path;
use std::sync::Arc;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::TcpStream;
use tokio_rustls::TlsConnector;
use tokio_rustls::rustls::crypto::ring;
use tokio_rustls::rustls::pki_types::pem::PemObject;
use tokio_rustls::rustls::pki_types::{CertificateDer, ServerName};
use tokio_rustls::rustls::version::TLS13;
use tokio_rustls::rustls::{ClientConfig, RootCertStore};

/// A broker that takes nothing for this long is gone, ms.
const TAKE_TIMEOUT_MS: u32 = 20_000;
/// Of the file with certificates.
const CA_BYTES_MAX: u64 = 256 * 1024;

/// A connection to read and write.
pub trait Stream: AsyncRead + AsyncWrite + Send + Sync + Unpin {}
impl<T: AsyncRead + AsyncWrite + Send + Sync + Unpin> Stream for T {}

/// Where the broker is, and what proves that it is the one.
#[derive(Clone)]
pub struct Way {
    broker: SocketAddr,
    tls: Option<(TlsConnector, ServerName<'static>)>,
}

impl Way {
    /// As configured. `broker`: of `fleet.broker`.
    pub fn new(settings: &Settings, broker: SocketAddr) -> Result<Self> {
        let Some(ca) = &settings.ca_file else { return Ok(Self { broker, tls: None }) };
        let roots = roots(ca)?;
        let failed = |e| Error::failure(format!("TLS cannot be had: {e}"));
        let provider = Arc::new(ring::default_provider());
        let config = ClientConfig::builder_with_provider(provider)
            .with_protocol_versions(&[&TLS13])
            .map_err(failed)?
            .with_root_certificates(roots)
            .with_no_client_auth();
        let name = match &settings.tls_name {
            None => ServerName::from(broker.ip()),
            Some(name) => ServerName::try_from(name.clone()).map_err(|e| {
                Error::configuration(format!("fleet.tls_name = {name:?}: {e}"))
                    .allowed("a name or address as the broker's certificate has it")
                    .remedy("look with `openssl x509 -noout -ext subjectAltName`")
            })?,
        };
        Ok(Self { broker, tls: Some((TlsConnector::from(Arc::new(config)), name)) })
    }

    /// The broker.
    pub fn broker(&self) -> SocketAddr {
        self.broker
    }

    /// Connect.
    pub async fn dial(self) -> std::io::Result<Box<dyn Stream>> {
        let stream = TcpStream::connect(self.broker).await?;
        let _ = stream.set_nodelay(true);
        let _ = rustix::net::sockopt::set_tcp_user_timeout(&stream, TAKE_TIMEOUT_MS);
        Ok(match self.tls {
            None => Box::new(stream),
            Some((connector, name)) => Box::new(connector.connect(name, stream).await?),
        })
    }
}

fn roots(path: &Path) -> Result<RootCertStore> {
    let wrong = |what: String| {
        Error::configuration(what)
            .in_file(path)
            .allowed("certificates in PEM, as -----BEGIN CERTIFICATE-----")
            .remedy("correct fleet.ca_file")
    };
    let bytes = files::read(path, CA_BYTES_MAX)
        .map_err(|e| wrong(format!("fleet.ca_file cannot be read: {e}")))?;
    let mut roots = RootCertStore::empty();
    for certificate in CertificateDer::pem_slice_iter(&bytes) {
        let certificate =
            certificate.map_err(|e| wrong(format!("fleet.ca_file is damaged: {e}")))?;
        roots.add(certificate).map_err(|e| wrong(format!("fleet.ca_file: {e}")))?;
    }
    if roots.is_empty() {
        return Err(wrong("fleet.ca_file holds no certificate".to_owned()));
    }
    Ok(roots)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn who_signs_is_read_or_it_is_said_what_is_wrong() {
        let path = std::env::temp_dir().join(format!("beltgauge-ca-{}", std::process::id()));
        let broker = "127.0.0.1:8883".parse().expect("an address");
        let way = |text: &str| {
            std::fs::write(&path, text).expect("room");
            let settings = Settings { ca_file: Some(path.clone()), ..Settings::default() };
            Way::new(&settings, broker).err().map(|e| e.to_string()).unwrap_or_default()
        };
        for (text, part) in [
            ("", "no certificate"),
            ("-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n", "fleet.ca_file"),
            ("-----BEGIN CERTIFICATE-----\nAAAA\n", "damaged"),
        ] {
            let error = way(text);
            assert!(error.contains(part) && error.contains("PEM"), "{text}: {error}");
        }
        std::fs::remove_file(&path).expect("ours");
        assert!(Way::new(&Settings::default(), broker).is_ok(), "without TLS");
    }
}
