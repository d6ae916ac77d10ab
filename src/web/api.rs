//! What can be asked for, and the answers.

use super::assets::ASSETS;
use super::board::{Board, PARCELS_MAX, View};
use super::bundle::{self, Packing};
use super::change;
use super::guard::{self, Hosts};
use super::metrics;
use super::model::{Archived, BundleFile, Event, Keeper, Machine, Parcel, Point};
use crate::config::Web as Settings;
use crate::event::csv;
use axum::body::Body;
use axum::extract::{Path, RawQuery, Request, State};
use axum::http::{Method, StatusCode, header};
use axum::middleware::{self, Next};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use axum::{Json, Router};
use serde::Serialize;
use std::borrow::Borrow;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::{Mutex, Semaphore};

/// A request for a live picture waits this long for one that is due.
const PICTURE_PATIENCE: Duration = Duration::from_secs(1);
/// Inner corners along a side of a board.
const BOARD_SIDES: std::ops::RangeInclusive<u8> = 3..=60;
/// Entries of the archive in one answer.
const ARCHIVED_MAX: usize = 100;
/// Pieces of the trend in one answer; a page asks until there are no more.
const POINTS_MAX: usize = 500;
/// Support bundles that are made at once: each holds a file and the packer's tables, about 2 MB.
const BUNDLES_MAX: usize = 4;
/// A number in a query has no more digits.
const DIGITS_MAX: usize = 20;

/// How long a request waits for a live picture: the next one may not be made before its time.
fn patience(settings: &Settings) -> Duration {
    PICTURE_PATIENCE + Duration::from_secs(1) / settings.pictures_per_s_max.max(1)
}

/// What the answers are made from.
#[derive(Clone)]
pub(super) struct Sources {
    patience: Duration,
    pub(super) board: Arc<Board>,
    machine: Arc<dyn Machine>,
    /// None: nothing can be changed.
    pub(super) keeper: Option<Arc<dyn Keeper>>,
    /// One code is tried at a time, and one file taken.
    pub(super) sign_ins: Arc<Mutex<()>>,
    pub(super) files: Arc<Mutex<()>>,
    questions: Arc<Semaphore>,
    bundles: Arc<Semaphore>,
}

/// All that is served; so many questions at most may wait for the disk as there are visitors.
pub(super) fn router(
    board: Arc<Board>,
    machine: Arc<dyn Machine>,
    keeper: Option<Arc<dyn Keeper>>,
    settings: &Settings,
) -> Router {
    let gate = Gate { hosts: Hosts::new(settings), is_closed: keeper.is_none() };
    // A visitor asks one question at a time.
    let questions = Arc::new(Semaphore::new(settings.connections_max));
    let bundles = Arc::new(Semaphore::new(BUNDLES_MAX));
    let patience = patience(settings);
    let mut router = Router::new();
    for (path, kind, bytes) in ASSETS {
        let asset = move || async move { ([(header::CONTENT_TYPE, *kind)], *bytes) };
        router = router.route(path, get(asset));
    }
    router
        .route("/api/state", get(state))
        .route("/api/plc", get(plc))
        .route("/api/parcels", get(parcels))
        .route("/api/parcels.csv", get(parcels_csv))
        .route("/api/parcels/{n}/picture", get(parcel_picture))
        .route("/api/events", get(events))
        .route("/api/trend", get(trend))
        .route("/api/live/{view}", get(live))
        .route("/api/still/{frame}", get(still))
        .route("/api/archive", get(archive))
        .route("/api/archive/{entry}/picture", get(archive_picture))
        .route("/api/bundle.tar.gz", get(bundle))
        .route("/metrics", get(metrics))
        .fallback(|| async { refusal(StatusCode::NOT_FOUND, "there is no such page") })
        .merge(change::routes())
        .layer(middleware::from_fn_with_state(gate, admit))
        .with_state(Sources {
            patience,
            board,
            machine,
            keeper,
            sign_ins: Arc::default(),
            files: Arc::default(),
            questions,
            bundles,
        })
}

/// What is asked of every request.
#[derive(Clone)]
struct Gate {
    hosts: Hosts,
    /// Nothing can be changed.
    is_closed: bool,
}

/// For visitors whom `web.allow` does not name: nothing but why.
pub(super) fn closed() -> Router {
    let text = "this address may not see the page: put it into web.allow";
    let protected = |mut answer: Response| {
        guard::protect(answer.headers_mut());
        answer
    };
    Router::new().fallback(move || async move { protected(refusal(StatusCode::FORBIDDEN, text)) })
}

/// An answer that says what was wrong.
fn refusal(status: StatusCode, text: &'static str) -> Response {
    (status, text).into_response()
}

/// Turn away who may not ask, and tell browsers what they may do with the answer.
async fn admit(State(gate): State<Gate>, request: Request, next: Next) -> Response {
    let only_reads = matches!(*request.method(), Method::GET | Method::HEAD);
    let mut answer = if !gate.hosts.admit(&request) {
        let text = "this machine is not called so: ask for it by its address, or put the name into web.hosts";
        refusal(StatusCode::MISDIRECTED_REQUEST, text)
    } else if !only_reads && gate.is_closed {
        refusal(StatusCode::METHOD_NOT_ALLOWED, "nothing can be changed here: only GET is answered")
    } else if !only_reads && !change::is_own_page(request.headers()) {
        refusal(StatusCode::FORBIDDEN, "only this machine's own page can change anything")
    } else {
        next.run(request).await
    };
    guard::protect(answer.headers_mut());
    answer
}

/// What is wrong with a query.
struct BadQuery(&'static str);

const NO_NUMBER: BadQuery = BadQuery("a number in the query is none: write it in digits");
const NO_BOARD: BadQuery = BadQuery("a board has 3 to 60 inner corners along each side");

impl From<BadQuery> for Response {
    fn from(BadQuery(text): BadQuery) -> Self {
        refusal(StatusCode::BAD_REQUEST, text)
    }
}

/// A number in a query, as in `since=12&limit=5`.
fn number(query: Option<&str>, name: &str) -> Result<Option<u64>, BadQuery> {
    let mut pairs = query.unwrap_or_default().split('&').filter_map(|pair| pair.split_once('='));
    let Some((_, text)) = pairs.find(|(key, _)| *key == name) else { return Ok(None) };
    let is_number =
        (1..=DIGITS_MAX).contains(&text.len()) && text.bytes().all(|b| b.is_ascii_digit());
    match text.parse() {
        Ok(number) if is_number => Ok(Some(number)),
        _ => Err(NO_NUMBER),
    }
}

async fn state(State(from): State<Sources>) -> Response {
    Json(from.machine.state()).into_response()
}

async fn plc(State(from): State<Sources>) -> Response {
    Json(from.machine.plc()).into_response()
}

async fn metrics(State(from): State<Sources>) -> Response {
    let text = metrics::text(&from.machine.state());
    ([(header::CONTENT_TYPE, metrics::CONTENT_TYPE)], text).into_response()
}

/// A part of a list, and where it goes on.
#[derive(Serialize)]
struct Listed<'a, T> {
    /// Number of this run: when it changes, numbers begin anew.
    run: u64,
    items: Vec<&'a T>,
    /// Ask for what comes after it with `since`.
    next: u64,
}

fn listed<T: Serialize>(
    board: &Board,
    items: &[impl Borrow<T>],
    since: u64,
    n: impl Fn(&T) -> u64,
) -> Response {
    let next = items.last().map_or(since, |item| n(item.borrow()));
    let items = items.iter().map(Borrow::borrow).collect();
    Json(Listed { run: board.started_ms(), items, next }).into_response()
}

async fn parcels(
    State(from): State<Sources>,
    RawQuery(query): RawQuery,
) -> Result<Response, Response> {
    let since = number(query.as_deref(), "since")?.unwrap_or(0);
    let limit = number(query.as_deref(), "limit")?.map_or(PARCELS_MAX, |n| n as usize);
    let items = from.board.parcels_since(since, limit);
    Ok(listed(&from.board, &items, since, |parcel: &Parcel| parcel.n))
}

/// The last parcels, for a spreadsheet.
async fn parcels_csv(State(from): State<Sources>) -> Response {
    let headers = [
        (header::CONTENT_TYPE, "text/csv; charset=utf-8"),
        (header::CONTENT_DISPOSITION, "attachment; filename=\"parcels.csv\""),
    ];
    (headers, parcel_table(&from)).into_response()
}

fn parcel_table(from: &Sources) -> String {
    let state = from.machine.state();
    let mut text = csv::header("n");
    for parcel in from.board.parcels_since(0, PARCELS_MAX) {
        let mut record = serde_json::to_value(&*parcel).unwrap_or_default();
        if let Some(record) = record.as_object_mut() {
            record.insert("boots".to_owned(), state.boots.into());
            record.insert("version".to_owned(), state.version.into());
        }
        text.push('\n');
        text.push_str(&csv::line(parcel.n, parcel.utc_ms, &record));
    }
    text.push('\n');
    text
}

/// Everything that a person elsewhere needs to see what is wrong.
async fn bundle(State(from): State<Sources>) -> Result<Response, Response> {
    let busy = |_| refusal(StatusCode::SERVICE_UNAVAILABLE, "others are taking it: ask again");
    let place = Arc::clone(&from.bundles).try_acquire_owned().map_err(busy)?;
    let files = own_files(&from).into_iter().chain(from.machine.bundle());
    let packing = Packing::new(Box::new(files), from.machine.state().utc_ms);
    let headers = [
        (header::CONTENT_TYPE, "application/gzip"),
        (header::CONTENT_DISPOSITION, "attachment; filename=\"beltgauge-bundle.tar.gz\""),
    ];
    Ok((headers, Body::from_stream(bundle::stream(packing, place))).into_response())
}

/// What the page shows, as files of the bundle.
fn own_files(from: &Sources) -> [BundleFile; 4] {
    let json = |what: serde_json::Result<Vec<u8>>| what.map_err(|e| e.to_string());
    let events = from.board.events_since(0);
    let events: Vec<&Event> = events.iter().map(|event| &**event).collect();
    [
        ("state.json", json(serde_json::to_vec_pretty(&from.machine.state()))),
        ("plc.json", json(serde_json::to_vec_pretty(&from.machine.plc()))),
        ("events.json", json(serde_json::to_vec_pretty(&events))),
        ("parcels.csv", Ok(parcel_table(from).into_bytes())),
    ]
    .map(|(name, bytes)| BundleFile { name: name.to_owned(), bytes })
}

async fn events(
    State(from): State<Sources>,
    RawQuery(query): RawQuery,
) -> Result<Response, Response> {
    let since = number(query.as_deref(), "since")?.unwrap_or(0);
    let items = from.board.events_since(since);
    Ok(listed(&from.board, &items, since, |event: &Event| event.n))
}

async fn trend(
    State(from): State<Sources>,
    RawQuery(query): RawQuery,
) -> Result<Response, Response> {
    let since = number(query.as_deref(), "since")?.unwrap_or(0);
    let points = from.board.points_since(since, POINTS_MAX);
    Ok(listed(&from.board, &points, since, |point: &Point| point.n))
}

async fn parcel_picture(State(from): State<Sources>, Path(n): Path<String>) -> Response {
    jpeg(n.parse().ok().and_then(|n| from.board.parcel_picture(n)))
}

fn jpeg(bytes: Option<impl IntoResponse>) -> Response {
    match bytes {
        Some(bytes) => ([(header::CONTENT_TYPE, "image/jpeg")], bytes).into_response(),
        None => refusal(StatusCode::NOT_FOUND, "there is no such picture, or no longer"),
    }
}

/// A line of JSON that describes the picture, then the picture, a JPEG.
async fn live(
    State(from): State<Sources>,
    Path(view): Path<String>,
    RawQuery(query): RawQuery,
) -> Result<Response, Response> {
    let view = match view.as_str() {
        "belt" => View::Belt,
        "raw" => View::Raw,
        "setup" => View::Setup,
        _ => return Err(refusal(StatusCode::NOT_FOUND, "the views are belt, raw and setup")),
    };
    if view == View::Setup {
        from.board.look_for(board_sides(query.as_deref())?);
    }
    let shown = number(query.as_deref(), "after")?;
    let next = from.board.next_picture(view, shown);
    Ok(match tokio::time::timeout(from.patience, next).await {
        Ok(picture) => {
            let kind = [(header::CONTENT_TYPE, "application/octet-stream")];
            (kind, picture.bytes.clone()).into_response()
        }
        Err(_) => StatusCode::NO_CONTENT.into_response(),
    })
}

/// Inner corners of the board to look for, as in `columns=9&rows=6`.
fn board_sides(query: Option<&str>) -> Result<Option<[u8; 2]>, BadQuery> {
    let (columns, rows) = (number(query, "columns")?, number(query, "rows")?);
    let (Some(columns), Some(rows)) = (columns, rows) else { return Ok(None) };
    let side = |n: u64| u8::try_from(n).ok().filter(|n| BOARD_SIDES.contains(n));
    side(columns).zip(side(rows)).map(|sides| Some(sides.into())).ok_or(NO_BOARD)
}

/// The camera's picture of a frame that showed a board just now, every pixel of it.
async fn still(State(from): State<Sources>, Path(frame): Path<String>) -> Response {
    match frame.parse().ok().and_then(|frame| from.board.whole_picture(frame)) {
        Some(file) => ([(header::CONTENT_TYPE, "image/x-portable-graymap")], file).into_response(),
        None => refusal(StatusCode::NOT_FOUND, "that picture is not kept, or no longer"),
    }
}

/// Ask the disk on a thread that may wait for it.
async fn read<T: Send + 'static>(
    from: &Sources,
    read: impl FnOnce(&dyn Machine) -> T + Send + 'static,
) -> Result<T, Response> {
    // Who asks and goes away leaves his question behind: so many may wait for the disk, and no more.
    let busy = |_| refusal(StatusCode::SERVICE_UNAVAILABLE, "the archive is being read by others");
    let place = Arc::clone(&from.questions).try_acquire_owned().map_err(busy)?;
    let machine = Arc::clone(&from.machine);
    let failed = |_| refusal(StatusCode::INTERNAL_SERVER_ERROR, "the archive was not read");
    let answer = move || {
        let _place = place;
        read(&*machine)
    };
    tokio::task::spawn_blocking(answer).await.map_err(failed)
}

async fn archive(
    State(from): State<Sources>,
    RawQuery(query): RawQuery,
) -> Result<Response, Response> {
    let before = number(query.as_deref(), "before")?;
    let limit = number(query.as_deref(), "limit")?.map_or(ARCHIVED_MAX, |n| n as usize);
    let limit = limit.min(ARCHIVED_MAX);
    let archived: Result<Archived, String> =
        read(&from, move |machine| machine.archived(before, limit)).await?;
    Ok(match archived {
        Ok(archived) => Json(archived).into_response(),
        Err(why) => (StatusCode::SERVICE_UNAVAILABLE, why).into_response(),
    })
}

async fn archive_picture(
    State(from): State<Sources>,
    Path(entry): Path<String>,
) -> Result<Response, Response> {
    let Ok(entry) = entry.parse() else { return Ok(jpeg(None::<Vec<u8>>)) };
    Ok(jpeg(read(&from, move |machine| machine.archived_picture(entry)).await?))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_request_outwaits_the_pause_between_pictures_at_every_rate() {
        for pictures_per_s_max in 1..=60 {
            let settings = Settings { pictures_per_s_max, ..Settings::default() };
            let pause = Duration::from_secs(1) / pictures_per_s_max;
            // Beside the pause: some frames of a slow camera, and the desk's look.
            assert!(patience(&settings) >= pause + Duration::from_secs(1), "{pictures_per_s_max}");
        }
    }
}
