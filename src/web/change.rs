//! What whoever has signed in can change, and how it is known that it is he and his own page that asks.
//!
//! A change needs three things: the cookie that signing in gave, which no script can read; a token made from
//! it, which no other site's page can read; and the browser's word that the page is this machine's
//! (`Origin`). The code for signing in is tried by one visitor at a time, and a wrong one costs a pause.

use super::api::Sources;
use super::board::Board;
use super::model::{Change, Event, Keeper, WorkState};
use axum::body::{Body, to_bytes};
use axum::extract::{Extension, Path, State};
use axum::http::{HeaderMap, HeaderValue, StatusCode, Uri, header};
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post, put};
use axum::{Json, Router};
use serde::Serialize;
use sha2::{Digest, Sha256};
use std::borrow::Cow;
use std::net::IpAddr;
use std::sync::Arc;
use std::time::Duration;

/// Its value is the secret of whoever has signed in.
const COOKIE: &str = "beltgauge";
/// Header with the token.
const TOKEN: &str = "x-beltgauge-token";
/// A code is no longer.
const CODE_BYTES_MAX: usize = 64;
/// A file that a visitor brings.
const FILE_BYTES_MAX: usize = 32 << 20;
/// After a wrong code the next one waits for this, whoever brings it.
const WRONG_CODE: Duration = Duration::from_millis(500);

/// Why something is not done.
struct Refusal {
    status: StatusCode,
    why: Cow<'static, str>,
}

type Answer = Result<Response, Refusal>;

impl IntoResponse for Refusal {
    fn into_response(self) -> Response {
        (self.status, self.why).into_response()
    }
}

/// All that is changed.
pub(super) fn routes() -> Router<Sources> {
    Router::new()
        .route("/api/session", get(session).post(sign_in).delete(sign_out))
        .route("/api/site", get(site))
        .route("/api/site/{change}", post(change))
        .route("/api/tray", post(clear))
        .route("/api/tray/{name}", put(put_file))
        .route("/api/tray/{folder}/{name}", put(put_in_folder))
}

/// Whether a change is asked for by a page of this machine: the browser says so.
pub(super) fn is_own_page(headers: &HeaderMap) -> bool {
    let text = |name| headers.get(name).and_then(|value: &HeaderValue| value.to_str().ok());
    let (Some(origin), Some(host)) = (text(header::ORIGIN), text(header::HOST)) else {
        return false;
    };
    let origin: Option<Uri> = origin.parse().ok();
    let authority = origin.as_ref().and_then(Uri::authority);
    authority.is_some_and(|authority| authority.as_str().eq_ignore_ascii_case(host))
}

fn refused(status: StatusCode, why: &'static str) -> Refusal {
    Refusal { status, why: why.into() }
}

fn failed(why: String) -> Refusal {
    Refusal { status: StatusCode::CONFLICT, why: why.into() }
}

fn keeper(from: &Sources) -> Result<Arc<dyn Keeper>, Refusal> {
    let text = "nothing can be changed here: this machine runs with a configuration file, not with a store";
    from.keeper.clone().ok_or_else(|| refused(StatusCode::NOT_FOUND, text))
}

/// The secret that the visitor's browser has, if it is of whoever has signed in.
fn secret(keeper: &dyn Keeper, headers: &HeaderMap) -> Option<String> {
    let cookies = headers.get_all(header::COOKIE).iter().filter_map(|value| value.to_str().ok());
    let mut pairs =
        cookies.flat_map(|text| text.split(';')).filter_map(|p| p.trim().split_once('='));
    let (_, secret) =
        pairs.find(|(name, secret)| *name == COOKIE && keeper.is_signed_in(secret))?;
    Some(secret.to_owned())
}

/// Only a page of this machine can know it: it is in an answer that no other can read.
fn token(secret: &str) -> String {
    format!("{:x}", Sha256::digest(format!("token {secret}")))
}

/// The keeper, for whoever has signed in and asks from the machine's own page.
fn admitted(from: &Sources, headers: &HeaderMap) -> Result<Arc<dyn Keeper>, Refusal> {
    let keeper = keeper(from)?;
    let text = "sign in first";
    let secret =
        secret(&*keeper, headers).ok_or_else(|| refused(StatusCode::UNAUTHORIZED, text))?;
    let given = headers.get(TOKEN).and_then(|value| value.to_str().ok());
    if given != Some(token(&secret).as_str()) {
        return Err(refused(StatusCode::FORBIDDEN, "the token is missing: load the page again"));
    }
    Ok(keeper)
}

/// Ask the keeper on a thread that may wait for the disk.
async fn ask<T: Send + 'static>(
    keeper: Arc<dyn Keeper>,
    ask: impl FnOnce(&dyn Keeper) -> T + Send + 'static,
) -> Result<T, Refusal> {
    let text = "the store was not asked";
    let answer = tokio::task::spawn_blocking(move || ask(&*keeper)).await;
    answer.map_err(|_| refused(StatusCode::INTERNAL_SERVER_ERROR, text))
}

fn note(board: &Board, kind: &'static str, visitor: IpAddr) {
    tracing::info!(%visitor, "page: {kind}");
    let utc_ms = crate::event::clock::utc_ms();
    board.note(Event { n: 0, utc_ms, kind, code: 0, detail: visitor.to_string() });
}

/// Whether anything can be changed, and by whoever asks.
#[derive(Serialize)]
struct Standing {
    can_be_changed: bool,
    token: Option<String>,
}

async fn session(State(from): State<Sources>, headers: HeaderMap) -> Response {
    let keeper = from.keeper.as_ref();
    let secret = keeper.and_then(|keeper| secret(&**keeper, &headers));
    let token = secret.map(|secret| token(&secret));
    Json(Standing { can_be_changed: keeper.is_some(), token }).into_response()
}

async fn sign_in(
    State(from): State<Sources>,
    Extension(visitor): Extension<IpAddr>,
    body: Body,
) -> Answer {
    let keeper = keeper(&from)?;
    let wrong = || refused(StatusCode::FORBIDDEN, "this is not the code, or it was used before");
    let code = to_bytes(body, CODE_BYTES_MAX).await.map_err(|_| wrong())?;
    let code = String::from_utf8_lossy(&code).into_owned();
    let turn = from.sign_ins.lock_owned().await;
    let secret = ask(keeper, move |keeper| keeper.sign_in(&code)).await?.map_err(failed)?;
    let Some(secret) = secret else {
        // Also when whoever guessed does not wait for the answer.
        tokio::spawn(async move {
            tokio::time::sleep(WRONG_CODE).await;
            drop(turn);
        });
        return Err(wrong());
    };
    note(&from.board, "signed_in", visitor);
    // The keeper knows how long it is good; the browser forgets it when it is closed.
    let cookie = format!("{COOKIE}={secret}; Path=/; HttpOnly; SameSite=Strict");
    let standing = Json(Standing { can_be_changed: true, token: Some(token(&secret)) });
    Ok(([(header::SET_COOKIE, cookie)], standing).into_response())
}

async fn sign_out(State(from): State<Sources>, headers: HeaderMap) -> Answer {
    let keeper = admitted(&from, &headers)?;
    ask(keeper, Keeper::sign_out).await?.map_err(failed)?;
    let gone = format!("{COOKIE}=; Path=/; HttpOnly; SameSite=Strict; Max-Age=0");
    Ok(([(header::SET_COOKIE, gone)], StatusCode::NO_CONTENT).into_response())
}

async fn site(State(from): State<Sources>, headers: HeaderMap) -> Answer {
    let keeper = admitted(&from, &headers)?;
    Ok(Json(ask(keeper, Keeper::site).await?).into_response())
}

async fn clear(State(from): State<Sources>, headers: HeaderMap) -> Answer {
    let keeper = admitted(&from, &headers)?;
    ask(keeper, Keeper::clear).await?.map_err(failed)?;
    Ok(StatusCode::NO_CONTENT.into_response())
}

async fn put_file(
    State(from): State<Sources>,
    Path(name): Path<String>,
    headers: HeaderMap,
    body: Body,
) -> Answer {
    receive(from, name, &headers, body).await
}

async fn put_in_folder(
    State(from): State<Sources>,
    Path((folder, name)): Path<(String, String)>,
    headers: HeaderMap,
    body: Body,
) -> Answer {
    receive(from, format!("{folder}/{name}"), &headers, body).await
}

/// Take a file on to the tray; one at a time, as it is held whole.
async fn receive(from: Sources, path: String, headers: &HeaderMap, body: Body) -> Answer {
    let keeper = admitted(&from, headers)?;
    let _turn = from.files.lock().await;
    let too_large = |_| refused(StatusCode::PAYLOAD_TOO_LARGE, "a file may have 32 MiB");
    let bytes = to_bytes(body, FILE_BYTES_MAX).await.map_err(too_large)?;
    ask(keeper, move |keeper| keeper.put(&path, &bytes)).await?.map_err(failed)?;
    Ok(StatusCode::NO_CONTENT.into_response())
}

async fn change(
    State(from): State<Sources>,
    Extension(visitor): Extension<IpAddr>,
    Path(change): Path<String>,
    headers: HeaderMap,
) -> Answer {
    let keeper = admitted(&from, &headers)?;
    let (change, kind) = match change.as_str() {
        "check" => (Change::Check, "site_check"),
        "apply" => (Change::Apply, "site_apply"),
        "back" => (Change::GoBack, "site_go_back"),
        _ => return Err(refused(StatusCode::NOT_FOUND, "the changes are check, apply and back")),
    };
    ask(keeper, move |keeper| keeper.change(change)).await?.map_err(failed)?;
    note(&from.board, kind, visitor);
    Ok((StatusCode::ACCEPTED, Json(WorkState::Busy)).into_response())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_page_is_ours_when_the_browser_says_so() {
        let is_ours = |origin: Option<&str>, host: &str| {
            let mut headers = HeaderMap::new();
            headers.insert(header::HOST, host.parse().expect("a header"));
            if let Some(origin) = origin {
                headers.insert(header::ORIGIN, origin.parse().expect("a header"));
            }
            is_own_page(&headers)
        };
        assert!(is_ours(Some("http://192.168.1.50:8080"), "192.168.1.50:8080"));
        assert!(is_ours(Some("https://Lane3"), "lane3"), "behind a server that encrypts");
        for origin in [
            None,
            Some("null"),
            Some(""),
            Some("http://evil.example.com"),
            Some("http://192.168.1.50"),
            Some("http://192.168.1.50:8081"),
            Some("http://192.168.1.50:8080.evil.example.com"),
            Some("http://evil.example.com@192.168.1.50:8080"),
        ] {
            assert!(!is_ours(origin, "192.168.1.50:8080"), "{origin:?}");
        }
    }
}
