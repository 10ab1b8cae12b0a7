//! Serves a local page of a results folder, which follows running trainings.
//!
//! The server only answers requests from this machine: it listens on 127.0.0.1, and refuses requests whose `Host` names
//! another machine or whose `Origin` is another site. A link from another site opens the page. It never writes to the
//! results folder, except for the copies of tables in `compacted/`.
//!
//! ```text
//! GET  /                    the page, and its scripts and styles
//! GET  /api/runs            all runs with their overall metrics; with `?version=N`, 304 if nothing has changed
//! GET  /api/run?run=NAME    one run: settings, metrics, losses, images; NAME is `experiment/run`
//! GET  /api/settings        the settings in which runs differ, with their values
//! GET  /api/compare?experiment=NAME  the metrics of an experiment's networks beside those of baselines
//! GET  /api/claims          the verdicts on the paper's statements
//! GET  /api/tables          all tables with their columns
//! POST /api/sql             the answer to the query in the body
//! ```

mod answers;
mod guard;
mod http;
mod snapshot;

use answers::{Answer, Failure};
use harness_claims::ClaimsFile;
use harness_registry::Registry;
use http::{Request, Response};
use snapshot::Snapshot;
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// How long the server waits before it checks again whether it should end.
const WAIT: Duration = Duration::from_millis(100);

/// The page's files: path, type and contents.
const FILES: [(&str, &str, &str); 6] = [
    ("/", "text/html; charset=utf-8", include_str!("page/index.html")),
    ("/style.css", "text/css; charset=utf-8", include_str!("page/style.css")),
    ("/charts.css", "text/css; charset=utf-8", harness_charts::STYLE),
    ("/charts.js", "text/javascript; charset=utf-8", harness_charts::SCRIPT),
    ("/table.js", "text/javascript; charset=utf-8", include_str!("page/table.js")),
    ("/app.js", "text/javascript; charset=utf-8", include_str!("page/app.js")),
];

/// Headers of every answer. Browsers run only the page's own scripts, and show the page in no frame of another site.
const HEADERS: [(&str, &str); 5] = [
    (
        "Content-Security-Policy",
        "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self' data:; \
         frame-ancestors 'none'; base-uri 'none'; form-action 'none'",
    ),
    ("X-Content-Type-Options", "nosniff"),
    ("Referrer-Policy", "no-referrer"),
    ("Cross-Origin-Resource-Policy", "same-origin"),
    ("Cache-Control", "no-store"),
];

/// Why the page can't be served.
#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    /// The port can't be used, for example because another program uses it.
    #[error(
        "can't listen on 127.0.0.1:{port}: {reason}; choose another port with --port, or --port 0 for a free one"
    )]
    Listen {
        /// The wanted port.
        port: u16,
        /// What the system says.
        reason: String,
    },
}

/// Serves the page of a results folder until `cancelled` returns true.
///
/// # Arguments
/// * `registry`: the results folder
/// * `claims`: the statements that the page judges, and the readings that judge them too
/// * `port`: the port on 127.0.0.1; 0 for a free one
/// * `ready`: called with the address once requests are answered
/// * `cancelled`: whether to stop
///
/// # Errors
/// When the port can't be used.
pub fn serve(
    registry: Registry,
    claims: ClaimsFile,
    port: u16,
    ready: impl FnOnce(SocketAddr),
    cancelled: impl Fn() -> bool,
) -> Result<(), ServeError> {
    let unusable = |error: std::io::Error| ServeError::Listen { port, reason: error.to_string() };
    let listener = TcpListener::bind(("127.0.0.1", port)).map_err(unusable)?;
    let address = listener.local_addr().map_err(unusable)?;
    let site = Arc::new(Site { snapshot: Mutex::new(Snapshot::new(registry.clone())), registry, claims });
    site.lock().refresh();
    let ended = AtomicBool::new(false);
    std::thread::scope(|scope| {
        scope.spawn(|| {
            for stream in listener.incoming() {
                if ended.load(Ordering::Relaxed) {
                    break;
                }
                let Ok(stream) = stream else {
                    // The process may have too many open files at the moment.
                    std::thread::sleep(WAIT);
                    continue;
                };
                let site = site.clone();
                // The connections that are open when the server ends are not waited for. If there can be no more
                // threads, the connection is closed.
                let answer = move || http::answer(stream, |request| site.respond(request));
                let _ = std::thread::Builder::new().spawn(answer);
            }
        });
        ready(address);
        while !cancelled() {
            std::thread::sleep(WAIT);
        }
        ended.store(true, Ordering::Relaxed);
        // A last connection wakes the thread that waits for connections.
        let _ = TcpStream::connect(address);
    });
    Ok(())
}

/// The state that requests share.
struct Site {
    registry: Registry,
    claims: ClaimsFile,
    snapshot: Mutex<Snapshot>,
}

impl Site {
    fn lock(&self) -> MutexGuard<'_, Snapshot> {
        self.snapshot.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn respond(&self, request: &Request) -> Response {
        let (status, kind, body) = match self.answer(request) {
            Ok(Answer::File(kind, text)) => ("200 OK", kind, text.to_owned()),
            Ok(Answer::Json(text)) => ("200 OK", "application/json", text),
            Ok(Answer::Unchanged) => ("304 Not Modified", "application/json", String::new()),
            Err(failure) => (failure.status(), "text/plain; charset=utf-8", failure.message()),
        };
        Response { status, headers: HEADERS.into_iter().chain([("Content-Type", kind)]).collect(), body }
    }

    fn answer(&self, request: &Request) -> Result<Answer, Failure> {
        guard::check(request)?;
        let path = request.path();
        if request.method == "POST" && path == "/api/sql" {
            let runs = self.lock().recorded();
            // A registry never forgets what it has left out, so each query has its own.
            let registry = self.registry.anew();
            return answers::sql(&registry, &runs, &String::from_utf8_lossy(&request.body));
        }
        if request.method != "GET" {
            return Err(Failure::Method);
        }
        if let Some((_, kind, text)) = FILES.iter().find(|(name, ..)| *name == path) {
            return Ok(Answer::File(kind, text));
        }
        let parameter = |name: &str| {
            let mut pairs = request.query().split('&').filter_map(|pair| pair.split_once('='));
            pairs.find(|(key, _)| *key == name).map(|(_, value)| decoded(value))
        };
        match path {
            "/api/runs" => self.lock().runs(parameter("version").as_deref()),
            "/api/run" => {
                let missing = || Failure::Bad("the parameter `run` is missing".into());
                let recorded = self.lock().find(&parameter("run").ok_or_else(missing)?)?;
                answers::run(&self.registry, &recorded)
            }
            "/api/settings" => {
                let (version, runs) = {
                    let mut snapshot = self.lock();
                    let runs = snapshot.recorded();
                    match snapshot.settings() {
                        Some(known) => return Ok(Answer::Json(known.to_owned())),
                        None => (snapshot.version(), runs),
                    }
                };
                // Requests for other things are answered meanwhile.
                let settings = answers::settings(version, &runs);
                self.lock().remember_settings(version, settings.clone());
                Ok(Answer::Json(settings))
            }
            "/api/compare" => {
                let experiment = parameter("experiment");
                let missing = || Failure::Bad("the parameter `experiment` is missing".into());
                let (experiment, runs) = (experiment.ok_or_else(missing)?, self.lock().recorded());
                answers::compare(&self.registry, &runs, &experiment)
            }
            "/api/claims" => {
                let runs = self.lock().recorded();
                answers::claims(&self.registry, &runs, &self.claims)
            }
            "/api/tables" => Ok(answers::tables()),
            _ => Err(Failure::Unknown(path.to_owned())),
        }
    }
}

/// A value of a URL with its `%XX` and `+` decoded. Invalid UTF-8 is replaced.
fn decoded(text: &str) -> String {
    let mut bytes = Vec::new();
    let mut rest = text.as_bytes();
    while let [first, more @ ..] = rest {
        let digits = more.get(..2).and_then(|two| std::str::from_utf8(two).ok());
        let byte = digits.filter(|_| *first == b'%').and_then(|two| u8::from_str_radix(two, 16).ok());
        rest = if byte.is_some() { &more[2..] } else { more };
        bytes.push(byte.unwrap_or(if *first == b'+' { b' ' } else { *first }));
    }
    String::from_utf8_lossy(&bytes).into_owned()
}
