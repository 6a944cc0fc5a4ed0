//! Answers pairs over HTTP, or as they appear in a folder.

mod http;
mod metrics;
mod ring;
mod settings;
mod station;
mod tiles;
mod watch;

use std::io::ErrorKind;
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::Duration;

use anyhow::{Context, Result};
use barchan_datasets::{disparity_file, load_rig};
use clap::Parser;
use serde_json::json;
use signal_hook::consts::{SIGINT, SIGTERM};
use signal_hook::flag;

use crate::engine::{EngineSettings, load_engine};
use crate::output::Output;
use crate::preview::share;
use http::{Connection, Head, NoRequest, Response};
use settings::Settings;
use station::{Answer, Pair, Station};

/// Answer pairs with disparity, confidence, pose and map, over HTTP or from a folder
#[derive(Parser)]
#[command(after_help = "Examples:\n  \
    barchan serve --rig rig.toml --model rover\n  \
    curl -F left=@l.png -F right=@r.png http://127.0.0.1:8484/pairs\n  \
    barchan serve --config rover.toml --watch camera/ --consume --runs runs/ --keep-runs 5\n\n\
    Without a browser or a client of your own, `curl http://127.0.0.1:8484/` lists what can be asked.\n\
    Pairs must be rectified. A pose is that of the left camera in the frame of the run's first.")]
pub struct Args {
    /// All settings from a TOML file; flags win
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Where to listen [default: 127.0.0.1:8484]; beyond this machine a token is needed
    #[arg(long, value_name = "ADDRESS:PORT")]
    listen: Option<SocketAddr>,
    /// The rig of all pairs [default: rig.toml]
    #[arg(long, value_name = "FILE")]
    rig: Option<PathBuf>,
    /// x.onnx, x.safetensors, a run of `barchan train`, a shipped name, sgm or bm [default: rover]
    #[arg(long)]
    model: Option<String>,
    /// The first line of this file is a token that requests must bear; so is the variable BARCHAN_TOKEN
    #[arg(long, value_name = "FILE")]
    token_file: Option<PathBuf>,
    /// Takes pairs that appear in DIR/left and DIR/right, of the same and of growing names
    #[arg(long, value_name = "DIR")]
    watch: Option<PathBuf>,
    /// Removes pairs of the watched folder when they are answered
    #[arg(long)]
    consume: bool,
    /// Writes runs of `barchan slam` into this folder
    #[arg(long, value_name = "DIR")]
    runs: Option<PathBuf>,
    /// Keeps the newest runs [default: 10]
    #[arg(long, value_name = "COUNT")]
    keep_runs: Option<usize>,
    /// Pairs of a run [default: 3000]
    #[arg(long, value_name = "COUNT")]
    frames_per_run: Option<usize>,
    /// Largest body of a request, MiB [default: 16]
    #[arg(long, value_name = "MIB")]
    max_body: Option<u64>,
    /// Most pairs a second [default: 30]
    #[arg(long, value_name = "RATE")]
    max_rate: Option<f64>,
    /// Most connections at a time [default: 32]
    #[arg(long, value_name = "COUNT")]
    max_clients: Option<usize>,
    /// Answers that can be asked for later [default: 16]
    #[arg(long, value_name = "COUNT")]
    keep_answers: Option<usize>,
    /// Disparity only: neither pose nor map
    #[arg(long)]
    no_track: bool,
    /// Threads that work on one image; 0 leaves it to the engine
    #[arg(long)]
    threads: Option<usize>,
    /// How often the outlines of a network's disparity are moved to where the images have them [default: 1]
    #[arg(long, value_name = "PASSES")]
    outlines: Option<usize>,
    /// Edge of a voxel of the map, metres [default: 0.02]
    #[arg(long, value_name = "M")]
    voxel: Option<f64>,
    /// Edge of a cell of the map's tiles, metres [default: 0.05]
    #[arg(long, value_name = "M")]
    cell: Option<f64>,
}

impl Args {
    fn settings(self) -> Result<Settings> {
        let mut s = match &self.config {
            Some(path) => Settings::read(path)?,
            None => Settings::default(),
        };
        s.listen = self.listen.unwrap_or(s.listen);
        s.rig = self.rig.unwrap_or(s.rig);
        s.model = self.model.unwrap_or(s.model);
        s.token_file = self.token_file.or(s.token_file);
        s.watch = self.watch.or(s.watch);
        s.consume |= self.consume;
        s.runs = self.runs.or(s.runs);
        s.keep_runs = self.keep_runs.unwrap_or(s.keep_runs);
        s.frames_per_run = self.frames_per_run.unwrap_or(s.frames_per_run);
        s.max_body = self.max_body.unwrap_or(s.max_body);
        s.max_rate = self.max_rate.unwrap_or(s.max_rate);
        s.max_clients = self.max_clients.unwrap_or(s.max_clients);
        s.keep_answers = self.keep_answers.unwrap_or(s.keep_answers);
        s.track &= !self.no_track;
        s.threads = self.threads.unwrap_or(s.threads);
        s.outlines = self.outlines.unwrap_or(s.outlines);
        s.voxel = self.voxel.unwrap_or(s.voxel);
        s.cell = self.cell.unwrap_or(s.cell);
        s.check()?;
        Ok(s)
    }
}

pub fn run(args: Args, output: &Output, runtime: Option<&Path>) -> Result<()> {
    let settings = args.settings()?;
    let token = settings.token()?;
    let rig = load_rig(std::slice::from_ref(&settings.rig))?;
    let rig = rig.as_rectified().with_context(|| {
        format!(
            "{}: rectified = false\n  cure: `barchan data rectify` says what the rectified rig is; send its pairs",
            settings.rig.display()
        )
    })?;
    let engines = EngineSettings {
        threads: settings.threads,
        outlines: Some(settings.outlines),
        second_opinion: None,
        beside_other_work: false,
    }
    .streaming();
    let engine = load_engine(&settings.model, runtime, &engines)?;
    let name = engine.name();
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [SIGINT, SIGTERM] {
        // The second signal ends the process, see `barchan train`.
        flag::register_conditional_shutdown(signal, 130, Arc::clone(&stop))?;
        flag::register(signal, Arc::clone(&stop))?;
    }
    let listener = TcpListener::bind(settings.listen)
        .with_context(|| format!("{}: cannot listen there", settings.listen))?;
    listener.set_nonblocking(true)?;
    let address = listener.local_addr()?;
    let station = Station::new(settings.clone(), rig, engine)?;
    let service = Arc::new(Service {
        station,
        token,
        max_body: settings.max_body * 1024 * 1024,
        stop: Arc::clone(&stop),
        clients: AtomicUsize::new(0),
    });
    let watcher = settings.watch.clone().map(|folder| {
        let (service, consume) = (Arc::clone(&service), settings.consume);
        std::thread::spawn(move || {
            watch::watch(&folder, consume, &service.station, &service.stop);
        })
    });
    let said = json!({ "listening": address.to_string(), "engine": name });
    output.result(
        &said,
        &format!("listening on http://{address}, with {name}"),
    )?;

    accept(&listener, &service, settings.max_clients);
    drop(listener);
    if let Some(watcher) = watcher {
        // One that panicked has said so.
        let _ = watcher.join();
    }
    // Every connection ends after the request in hand.
    while service.clients.load(Ordering::Acquire) > 0 {
        std::thread::sleep(Duration::from_millis(10));
    }
    service.station.finish();
    Ok(())
}

/// Takes connections until the service stops, each into a thread of its own.
fn accept(listener: &TcpListener, service: &Arc<Service>, max_clients: usize) {
    while !service.stop.load(Ordering::Relaxed) {
        let stream = match listener.accept() {
            Ok((stream, _)) => stream,
            Err(e) => {
                // Nobody came, or there are too many open files for a moment.
                let pause = match e.kind() {
                    ErrorKind::WouldBlock => 5,
                    _ => 50,
                };
                std::thread::sleep(Duration::from_millis(pause));
                continue;
            }
        };
        if service.clients.load(Ordering::Acquire) >= max_clients {
            let message = format!("{max_clients} clients are connected\n  cure: try again");
            let refusal = Response::refusal(503, message).retry_after(1);
            service.station.metrics.responded(503);
            refuse_unread(stream, &refusal);
            continue;
        }
        let client = Client::new(Arc::clone(service));
        // Without a thread the connection is dropped, and the client tries again.
        let _ = std::thread::Builder::new().spawn(move || client.0.converse(stream));
    }
}

/// Answers in a moment or not at all: whoever waits here keeps all others out.
fn refuse_unread(stream: TcpStream, refusal: &Response) {
    let _ = stream.set_nonblocking(true);
    refusal.send_unasked(&stream);
}

/// One more is counted as long as this lives.
struct Client(Arc<Service>);

impl Client {
    fn new(service: Arc<Service>) -> Self {
        service.clients.fetch_add(1, Ordering::AcqRel);
        Self(service)
    }
}

impl Drop for Client {
    fn drop(&mut self) {
        self.0.clients.fetch_sub(1, Ordering::AcqRel);
    }
}

struct Service {
    station: Station,
    token: Option<String>,
    max_body: u64,
    stop: Arc<AtomicBool>,
    clients: AtomicUsize,
}

impl Service {
    /// Answers the requests of one connection until it ends.
    fn converse(&self, stream: TcpStream) {
        let Ok(mut connection) = Connection::new(stream, &self.stop) else {
            return;
        };
        loop {
            let head = match connection.head() {
                Ok(head) => head,
                Err(NoRequest::Closed) => return,
                Err(NoRequest::Bad(refusal)) => {
                    self.station.metrics.responded(refusal.status);
                    connection.answer(None, false, &refusal);
                    return;
                }
            };
            // What can be refused without its body is.
            let (response, body_read) = match self.admit(&head) {
                Err(refusal) => (refusal, head.length == 0),
                Ok(()) => match connection.body(&head) {
                    Ok(body) => (self.respond(&head, &body), true),
                    Err(NoRequest::Closed) => return,
                    Err(NoRequest::Bad(refusal)) => (refusal, false),
                },
            };
            self.station.metrics.responded(response.status);
            if !connection.answer(Some(&head), body_read, &response) {
                return;
            }
        }
    }

    /// Refuses what a client may not, or not now.
    fn admit(&self, head: &Head) -> Result<(), Response> {
        let refuse = |status, message: &str| Err(Response::refusal(status, message));
        if head.path != "/health" {
            match &self.token {
                Some(token) => {
                    let given = head.header("Authorization").unwrap_or_default();
                    let given = given.strip_prefix("Bearer ").unwrap_or_default();
                    if !same(given.as_bytes(), token.as_bytes()) {
                        return refuse(
                            401,
                            "the token is missing or wrong\n  cure: send the header Authorization: Bearer TOKEN",
                        );
                    }
                }
                // Any page in a browser on this machine could ask otherwise.
                None if head.header("Origin").is_some() => {
                    return refuse(
                        403,
                        "pages in a browser may not ask a service without a token",
                    );
                }
                None => {}
            }
        }
        if head.length > self.max_body {
            let message = format!(
                "the body has {} bytes, and {} are taken\n  cure: send PNG or JPEG, or start the service with a larger --max-body",
                head.length, self.max_body
            );
            return refuse(413, &message);
        }
        if head.method == "POST" && head.path == "/pairs" {
            self.station.admit()?;
        }
        Ok(())
    }

    fn respond(&self, head: &Head, body: &[u8]) -> Response {
        let path = head.path.split('?').next().unwrap_or_default();
        let mut parts = path.trim_matches('/').split('/');
        let parts = [parts.next(), parts.next(), parts.next(), parts.next()];
        if path == "/pairs" {
            return match head.method.as_str() {
                "POST" => self.pair(head, body).unwrap_or_else(|refusal| refusal),
                _ => Response::refusal(405, "pairs are sent with POST"),
            };
        }
        if !["GET", "HEAD"].contains(&head.method.as_str()) {
            return Response::refusal(405, "only pairs are sent; the rest is asked for with GET");
        }
        let found = match parts {
            [Some(""), None, ..] => Some(Response::new("text/plain; charset=utf-8", INDEX)),
            [Some("health"), None, ..] => Some(self.health()),
            [Some("metrics"), None, ..] => {
                let text = self.station.metrics.text();
                Some(Response::new("text/plain; version=0.0.4", text))
            }
            [Some("pairs"), Some(number), product, None] => {
                let number = number.parse().ok();
                let latest = parts[1] == Some("latest");
                let answer = (latest || number.is_some()).then(|| self.station.answer(number));
                answer.flatten().and_then(|a| product_of(&a, product))
            }
            [Some("map"), column, row, None] => self.map(column, row),
            _ => None,
        };
        found.unwrap_or_else(|| {
            let message = format!("{path}: there is no such thing (any more)\n  cure: see /");
            Response::refusal(404, message)
        })
    }

    fn health(&self) -> Response {
        match self.stop.load(Ordering::Relaxed) {
            false => Response::json(&json!({ "status": "ok" })),
            true => Response::json(&json!({ "status": "stopping" })).with_status(503),
        }
    }

    /// A pair out of a form with `left`, `right` and, if they are known, `time` and `name`.
    fn pair(&self, head: &Head, body: &[u8]) -> Result<Response, Response> {
        let kind = head.header("Content-Type").unwrap_or_default();
        if !kind.starts_with("multipart/form-data") {
            return Err(Response::refusal(
                415,
                "a pair is a form\n  cure: curl -F left=@l.png -F right=@r.png URL/pairs",
            ));
        }
        let refuse = |message: String| Response::refusal(400, format!("the form: {message}"));
        let fields = http::form(kind, body).map_err(refuse)?;
        let field = |name: &str| fields.iter().find(|f| f.0 == name).map(|f| f.1);
        let image = |name: &str| {
            let bytes = field(name).ok_or_else(|| refuse(format!("there is no {name}")))?;
            self.station.image(name, bytes)
        };
        let text = |name: &str| field(name).map(String::from_utf8_lossy);
        let time = match text("time") {
            None => None,
            Some(text) => {
                let time: Option<f64> = text.trim().parse().ok();
                let wanted = || refuse(format!("time is \"{text}\", expected seconds"));
                Some(time.filter(|t| t.is_finite()).ok_or_else(wanted)?)
            }
        };
        let name = text("name").map(|name| name.into_owned());
        // It becomes a field of a table.
        if name.as_ref().is_some_and(|n| {
            n.is_empty() || n.len() > 100 || n.contains(|c: char| c == ',' || c.is_control())
        }) {
            return Err(refuse(
                "name must have 1 to 100 characters, without commas".into(),
            ));
        }
        let pair = Pair {
            name,
            time,
            left: image("left")?,
            right: image("right")?,
        };
        let answer = self.station.process(pair)?;
        Ok(Response::json(&answer.told))
    }

    fn map(&self, column: Option<&str>, row: Option<&str>) -> Option<Response> {
        let terrain = match self.station.terrain() {
            Ok(terrain) => terrain,
            Err(e) => return Some(Response::refusal(404, format!("no map: {e:#}"))),
        };
        let (Some(column), Some(row)) = (column, row) else {
            return Some(Response::json(&terrain.describe()));
        };
        let (row, kind) = row.split_once('.')?;
        let (column, row) = (column.parse().ok()?, row.parse().ok()?);
        let (kind, bytes) = match kind {
            "tif" => ("image/tiff", terrain.elevation(column, row)?),
            "png" => ("image/png", terrain.shaded(column, row)?),
            _ => return None,
        };
        Some(file(kind, bytes))
    }
}

const INDEX: &str = "\
POST /pairs                    a form with left, right (images) and, if known, time (s) and name
GET  /pairs/N, /pairs/latest   what was answered of a pair
GET  /pairs/N/disparity.png    16 bits, 256 times the disparity; 0 is unknown
GET  /pairs/N/disparity.pfm    pixels; inf is unknown
GET  /pairs/N/sigma.pfm        standard deviation, pixels
GET  /pairs/N/confidence.png   8 bits, 255 is certain
GET  /map                      where the map of this run is, and its tiles
GET  /map/COLUMN/ROW.tif       elevation, GeoTIFF; .png is shaded
GET  /health, /metrics
";

fn product_of(answer: &Answer, product: Option<&str>) -> Option<Response> {
    let map = &answer.map;
    let Some(product) = product else {
        return Some(Response::json(&answer.told));
    };
    Some(match product {
        "disparity.png" => {
            let bytes = disparity_file::png_bytes(Path::new(product), &map.disparity);
            file("image/png", bytes.map_err(Into::into))
        }
        "disparity.pfm" => {
            let bytes = disparity_file::pfm_bytes(&map.disparity);
            Response::new("image/x-portable-floatmap", bytes)
        }
        "sigma.pfm" => {
            let bytes = disparity_file::pfm_bytes(&map.sigma);
            Response::new("image/x-portable-floatmap", bytes)
        }
        "confidence.png" => {
            let mut bytes = std::io::Cursor::new(vec![]);
            let written = share(&map.confidence).write_to(&mut bytes, image::ImageFormat::Png);
            file(
                "image/png",
                written.map(|()| bytes.into_inner()).map_err(Into::into),
            )
        }
        _ => return None,
    })
}

fn file(kind: &'static str, bytes: Result<Vec<u8>>) -> Response {
    match bytes {
        Ok(bytes) => Response::new(kind, bytes),
        Err(e) => Response::refusal(500, format!("{e:#}")),
    }
}

/// Whether two tokens are the same, in a time that does not say where they differ.
fn same(a: &[u8], b: &[u8]) -> bool {
    let differing = a.iter().zip(b).fold(0, |all, (x, y)| all | (x ^ y));
    a.len() == b.len() && differing == 0
}
