//! The MQTT 5 client, wrapped: nothing else of the project knows its crate.
//!
//! A connection is used once: what was not acknowledged when it ends is told anew on the next one, by
//! whoever keeps account of it, and nothing is left in a queue of the crate's.

use super::tls::Way;
use crate::error::{Error, Result};
use crate::store::files;
use rumqttc::{
    AsyncClient, Event, EventLoop, Incoming, LastWill, MqttOptions, PublishOptions, QoS,
    RetainForwardRule, SubscribeFilterInput,
};
use std::future::Future;
use std::path::Path;
use std::pin::Pin;
use std::time::Duration;
use tokio::sync::mpsc;
use tokio::task::JoinHandle;

/// A broker that says nothing for one and a half times this is gone, s.
const KEEP_ALIVE_S: u16 = 20;
/// To connect and be let in.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(10);
/// The broker is told to send nothing longer.
const PACKET_BYTES_MAX: u32 = 16 * 1024;
/// Messages that wait for whoever reads them; what comes beyond is dropped.
const MESSAGES_MAX: usize = 16;
/// Messages that may be on their way, and some that are not counted as such.
pub const IN_FLIGHT_MAX: usize = 64;
const ROOM: usize = 2 * IN_FLIGHT_MAX;

/// Who one is to the broker.
#[derive(Clone)]
pub struct Account {
    pub way: Way,
    pub client_id: String,
    pub login: Option<(String, String)>,
    /// Topic and payload that the broker tells, retained, when the connection breaks.
    pub will: (String, String),
}

/// What comes from the broker.
#[derive(Debug, PartialEq, Eq)]
pub enum Told {
    /// It has let us in.
    Connected,
    /// A message on a topic that was subscribed to.
    Message(Vec<u8>),
    /// The connection has ended.
    Ended(String),
}

/// Resolves when the broker has acknowledged, or says why it has not.
pub type Acknowledgment = Pin<Box<dyn Future<Output = std::result::Result<(), String>> + Send>>;

/// A connection, until it ends.
pub struct Connection {
    client: AsyncClient,
    told: mpsc::Receiver<Told>,
    task: JoinHandle<()>,
}

impl Connection {
    /// Begin to connect: [`Told::Connected`] or [`Told::Ended`] follows.
    pub fn open(account: &Account) -> Self {
        let (way, broker) = (account.way.clone(), account.way.broker());
        let host = (broker.ip().to_string(), broker.port());
        let mut options = MqttOptions::new(account.client_id.clone(), host);
        let (topic, will) = account.will.clone();
        options
            .set_keep_alive(KEEP_ALIVE_S)
            .set_clean_start(true)
            .set_connect_timeout(CONNECT_TIMEOUT)
            .set_max_packet_size(Some(PACKET_BYTES_MAX))
            // Without, the crate has tables for 65,535 of them, 18 MiB.
            .set_outgoing_inflight_upper_limit(IN_FLIGHT_MAX as u16)
            .set_last_will(LastWill::new(topic, will, QoS::AtLeastOnce, true, None))
            .set_socket_connector(move |_, _| way.clone().dial());
        if let Some((user, password)) = account.login.clone() {
            options.set_credentials(user, password);
        }
        let (client, events) = AsyncClient::builder(options).capacity(ROOM).build();
        let (tell, told) = mpsc::channel(MESSAGES_MAX);
        let task = tokio::spawn(attend(events, tell));
        Self { client, told, task }
    }

    /// What comes next.
    pub async fn next(&mut self) -> Told {
        self.told.recv().await.unwrap_or_else(|| Told::Ended("the connection has ended".to_owned()))
    }

    /// Have messages on a topic sent, but none that were retained.
    pub fn subscribe(&self, topic: &str) -> std::result::Result<(), String> {
        let never = RetainForwardRule::Never;
        let filter = SubscribeFilterInput::new(topic, QoS::AtLeastOnce).retain_forward_rule(never);
        self.client.try_subscribe_many([filter]).map_err(|e| e.to_string())
    }

    /// Tell something that the broker is to acknowledge.
    pub fn tell(
        &self,
        topic: &str,
        payload: String,
        retain: bool,
    ) -> std::result::Result<Acknowledgment, String> {
        let options = PublishOptions::new(QoS::AtLeastOnce).retain(retain);
        let notice = self
            .client
            .try_publish_tracked(topic.to_owned(), payload, options)
            .map_err(|e| e.to_string())?;
        Ok(Box::pin(async move { notice.wait_completion_async().await.map_err(|e| e.to_string()) }))
    }

    /// Tell something that may be lost.
    pub fn mention(&self, topic: &str, payload: String) -> std::result::Result<(), String> {
        let options = PublishOptions::new(QoS::AtMostOnce);
        self.client.try_publish(topic.to_owned(), payload, options).map_err(|e| e.to_string())
    }

    /// Take leave, so that the will is not told; what is on its way may be acknowledged within `patience`.
    pub async fn close(mut self, patience: Duration) {
        if self.client.disconnect_with_timeout(patience).await.is_ok() {
            let _ = tokio::time::timeout(2 * patience, &mut self.task).await;
        }
    }
}

impl Drop for Connection {
    fn drop(&mut self) {
        self.task.abort();
    }
}

/// The crate's connection, to its end.
async fn attend(mut events: EventLoop, tell: mpsc::Sender<Told>) {
    loop {
        match events.poll().await {
            Ok(Event::Incoming(Incoming::ConnAck(_))) => {
                let _ = tell.send(Told::Connected).await;
            }
            Ok(Event::Incoming(Incoming::Publish(message))) => {
                let _ = tell.try_send(Told::Message(message.payload.to_vec()));
            }
            Ok(Event::Incoming(Incoming::Disconnect(said))) => {
                let why = format!("the broker has hung up: {:?}", said.reason_code);
                let _ = tell.send(Told::Ended(why)).await;
                return;
            }
            Ok(_) => {}
            Err(e) => {
                let _ = tell.send(Told::Ended(e.to_string())).await;
                return;
            }
        }
    }
}

/// Of the file with user and password.
const LOGIN_BYTES_MAX: u64 = 1024;

/// User and password of a file's first two lines.
pub fn login(path: &Path) -> Result<(String, String)> {
    let wrong = |what: String| {
        Error::configuration(what)
            .in_file(path)
            .allowed("the user in the first line, the password in the second")
            .remedy("correct fleet.login_file")
    };
    let bytes = files::read(path, LOGIN_BYTES_MAX)
        .map_err(|e| wrong(format!("fleet.login_file cannot be read: {e}")))?;
    let text = String::from_utf8(bytes).map_err(|_| wrong("it is no text".to_owned()))?;
    match text.lines().collect::<Vec<_>>()[..] {
        [user, password] if !user.is_empty() => Ok((user.to_owned(), password.to_owned())),
        [_, _] => Err(wrong("there is no user".to_owned())),
        // Never what is in it.
        ref lines => Err(wrong(format!("it has {} lines", lines.len()))),
    }
}
