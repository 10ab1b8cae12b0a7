//! Makes the report: an HTML page with scenes, claims, readings, figures, charts, training curves and runs.
//!
//! The page is one self-contained HTML document, so it can be opened from a disk and sent by mail. Where runs are
//! missing, the page names the command that makes them. The same tables give the same bytes.
//!
//! `page.html` is the template. minijinja escapes every value in it that isn't marked as `safe`. `page.css` and
//! `page.js` are inserted unchanged. A content security policy lets browsers run only this script and load no file.

mod cache;
mod clips;
mod figures;
mod joints;
mod readings;
mod regression;
mod runs;
mod training;
mod verdicts;

use base64::Engine;
use base64::engine::general_purpose::STANDARD as BASE64;
use harness_analysis::{Analysis, AnalysisError, Setting};
use harness_claims::{self as claims, Claim, ClaimsError};
use harness_figures::source::{Experiments, Runs, Source, Study};
use harness_figures::{FORCES_SQL, FigureError};
use harness_registry::{QueryError, Registry};
use harness_shared::progress::Progress;
use harness_simulation::SimulationError;
use harness_spec::Experiment;
use minijinja::value::Serde;
use minijinja::{Environment, UndefinedBehavior};
use serde::Serialize;
use sha2::{Digest, Sha256};
use std::collections::BTreeSet;

const TEMPLATE: &str = include_str!("page.html");
const STYLE: &str = include_str!("page.css");
const SCRIPT: &str = include_str!("page.js");

/// Why the page can't be made.
#[derive(Debug, thiserror::Error)]
pub enum ReportError {
    /// A figure can't be drawn although its runs exist, or a table can't be read.
    #[error(transparent)]
    Figure(#[from] FigureError),
    /// A claim can't be judged, for example because its query is wrong.
    #[error(transparent)]
    Claims(#[from] ClaimsError),
    /// The runs can't be selected.
    #[error(transparent)]
    Analysis(#[from] AnalysisError),
    /// A table of losses can't be read.
    #[error(transparent)]
    Query(#[from] QueryError),
    /// The template can't be rendered.
    #[error("the page can't be put together: {0}")]
    Page(#[from] minijinja::Error),
    /// The data for the page's script can't be written as JSON.
    #[error("the page's data can't be written: {0}")]
    Data(#[from] serde_json::Error),
}

/// Why a part of the page is missing, and the command that makes its runs.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize)]
struct Absent {
    reason: String,
    command: Option<String>,
}

/// A part of the page, or the reason why it is missing.
#[derive(Serialize)]
#[serde(rename_all = "snake_case")]
enum Part<T> {
    There(T),
    Absent(Absent),
}

/// Converts the result of making a part. If the part failed because runs are missing, because runs differ in their
/// settings, or because there is no OpenGL driver, it becomes [`Part::Absent`].
///
/// # Errors
/// When the part failed for any other reason.
fn part<T>(outcome: Result<T, FigureError>) -> Result<Part<T>, FigureError> {
    let (reason, command) = match outcome {
        Ok(part) => return Ok(Part::There(part)),
        Err(FigureError::NoRuns { experiment, command, .. }) => {
            (format!("There is no finished run of {experiment}."), Some(command))
        }
        Err(FigureError::NoRows { experiment, command, .. }) => {
            (format!("The finished runs of {experiment} have no rows for this part."), Some(command))
        }
        Err(FigureError::Mixed(error)) => (sentence(&error.to_string()), None),
        Err(FigureError::Simulation(error @ SimulationError::NoRenderer { .. })) => {
            (format!("It could not be rendered: {error}."), None)
        }
        Err(error) => return Err(error),
    };
    Ok(Part::Absent(Absent { reason, command }))
}

/// Makes a message a sentence: with a capital letter and a full stop.
fn sentence(text: &str) -> String {
    let (first, rest) = text.split_at(1);
    format!("{}{rest}.", first.to_uppercase())
}

/// Calls `of_study` with the runs of each study. Returns all results, and a reason for each study without runs.
fn of_both<T>(
    source: &Source,
    of_study: impl Fn(&Runs, Study) -> Result<Vec<T>, FigureError>,
) -> Result<(Vec<T>, BTreeSet<Absent>), FigureError> {
    let (mut all, mut absent) = (Vec::new(), BTreeSet::new());
    for study in Study::BOTH {
        match part(source.runs(study).and_then(|runs| of_study(&runs, study)))? {
            Part::There(more) => all.extend(more),
            Part::Absent(reason) => drop(absent.insert(reason)),
        }
    }
    Ok((all, absent))
}

/// The values that the page's template uses.
#[derive(Serialize)]
struct Page {
    style: &'static str,
    script: &'static str,
    policy: String,
    quick: bool,
    /// The command that makes some runs in seconds.
    smoke: String,
    /// The number of runs that are done.
    done: usize,
    /// The commands that make the missing runs.
    commands: BTreeSet<String>,
    /// Notes about runs that were left out, and about runs whose settings differ.
    remarks: Vec<String>,
    clips: Part<Vec<clips::Clip>>,
    verdicts: verdicts::Verdicts,
    readings: Part<readings::Readings>,
    figures: Vec<figures::Drawn>,
    experiments: Vec<runs::Experiment>,
    /// Why results by joint and link are missing.
    joints_absent: BTreeSet<Absent>,
    /// Why predictions over references are missing.
    regression_absent: BTreeSet<Absent>,
    has: Has,
    /// [`Data`] as JSON.
    data: String,
}

/// Whether the script has data for each of its charts.
#[derive(Serialize)]
struct Has {
    joints: bool,
    regression: bool,
    training: bool,
}

/// The data of the charts and clips for the page's script.
#[derive(Serialize)]
struct Data {
    clips: Vec<clips::Frames>,
    joints: Vec<joints::Series>,
    regression: Vec<regression::Cloud>,
    training: Vec<training::Curves>,
}

/// Makes the page of a results folder and returns it as an HTML document.
///
/// # Arguments
/// * `registry`: the runs of the results folder
/// * `claims`: the statements to judge
/// * `readings`: the experiment with the readings of the paper, under which the claims are also judged
/// * `settings`: the settings that runs must have to be used
/// * `quick`: whether claims, figures and results use the runs made with `--quick`
/// * `progress`: shows how far the work is
///
/// # Errors
/// When a table is damaged or has unexpected columns, or a claim's query is wrong. Missing runs and a missing OpenGL
/// driver are no errors.
pub fn page(
    registry: &Registry,
    claims: &[Claim],
    readings: &Experiment,
    settings: &[Setting],
    quick: bool,
    progress: &dyn Progress,
) -> Result<String, ReportError> {
    let claims: Vec<&Claim> = claims.iter().collect();
    let mut selection = claims::selection(&claims, settings, quick);
    let drawn = Experiments::of_the_paper(quick);
    selection.experiments.extend(drawn.names());
    selection.experiments.push(readings.name.clone());
    let analysis = Analysis::new(registry, &selection)?;
    let analysis = claims::expect(analysis, &claims, quick).expect([joints::SQL, FORCES_SQL]);
    let source = Source::new(&analysis, drawn);
    let figures = figures::render(&source, progress)?;
    let verdicts = verdicts::Verdicts::of(&analysis, &claims, quick)?;
    let readings = readings::of(registry, &analysis, readings, &claims, settings)?;
    let experiments = runs::experiments(registry);
    let (clips, frames) = match part(clips::film(progress))? {
        Part::Absent(absent) => (Part::Absent(absent), Vec::new()),
        Part::There(filmed) => {
            let (clips, frames) = filmed.into_iter().unzip();
            (Part::There(clips), frames)
        }
    };
    let (joints, joints_absent) = joints::series(&source)?;
    let (regression, regression_absent) = regression::clouds(&source)?;
    let data = Data { clips: frames, joints, regression, training: training::curves(registry)? };

    let undrawn = figures.iter().filter_map(|figure| match &figure.svg {
        Part::Absent(absent) => Some(absent),
        Part::There(_) => None,
    });
    let absent = undrawn.chain(&joints_absent).chain(&regression_absent);
    let commands =
        absent.filter_map(|absent| absent.command.clone()).chain(verdicts.commands.clone()).collect();
    let page = Page {
        style: STYLE,
        script: SCRIPT,
        policy: policy(),
        quick,
        smoke: analysis.command("smoke", false),
        done: experiments.iter().map(|experiment| experiment.done).sum(),
        commands,
        remarks: analysis.notes().iter().chain(&verdicts.mixed).map(|text| sentence(text)).collect(),
        clips,
        verdicts,
        readings,
        figures,
        experiments,
        joints_absent,
        regression_absent,
        has: Has {
            joints: !data.joints.is_empty(),
            regression: !data.regression.is_empty(),
            training: !data.training.is_empty(),
        },
        data: script_safe(&serde_json::to_string(&data)?),
    };
    Ok(render(&page)?)
}

fn render(page: &Page) -> Result<String, minijinja::Error> {
    let mut templates = Environment::new();
    // A name in the template that the page doesn't define is an error.
    templates.set_undefined_behavior(UndefinedBehavior::SemiStrict);
    // minijinja escapes text for HTML because the template's name ends in `.html`.
    templates.add_template("page.html", TEMPLATE)?;
    templates.get_template("page.html")?.render(Serde(page))
}

/// Escapes JSON for a `script` element, so that no text in it can end the element or open another one.
fn script_safe(json: &str) -> String {
    json.replace('<', "\\u003c")
}

/// The page's content security policy. It allows the pictures in the page, and the page's own style and script by their
/// SHA-256. Injected text can't run as a script, and browsers load no other file.
fn policy() -> String {
    let digest = |text: &str| format!("'sha256-{}'", BASE64.encode(Sha256::digest(text)));
    format!(
        "default-src 'none'; img-src data:; style-src {}; script-src {}; base-uri 'none'; form-action 'none'",
        digest(STYLE),
        digest(SCRIPT)
    )
}

/// Rounds to five significant digits. A chart can't show more, and the page's data are half as large.
fn short(value: f64) -> f64 {
    format!("{value:.4e}").parse().unwrap_or(value)
}
