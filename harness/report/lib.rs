//! A page to read: scenes, claims, figures, results to look closer at, training curves and runs.
//!
//! The page is one HTML document that holds all it needs, so it opens from a disk and can be sent by mail. What
//! there are no runs for is said in it, with the command that makes them. The same tables give the same bytes.
//!
//! `page.html` is the template, in which minijinja escapes whatever is not said to be HTML already. `page.css` and
//! `page.js` go into it as they are; a content security policy lets browsers run this script alone, and load nothing.

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

/// Why there is no page.
#[derive(Debug, thiserror::Error)]
pub enum ReportError {
    #[error(transparent)]
    Figure(#[from] FigureError),
    #[error(transparent)]
    Claims(#[from] ClaimsError),
    #[error(transparent)]
    Analysis(#[from] AnalysisError),
    #[error(transparent)]
    Query(#[from] QueryError),
    #[error("the page can't be put together: {0}")]
    Page(#[from] minijinja::Error),
    #[error("the page's data can't be written: {0}")]
    Data(#[from] serde_json::Error),
}

/// Why a part of the page isn't there, and what brings it.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize)]
struct Absent {
    reason: String,
    command: Option<String>,
}

/// A part of the page, or why it isn't there.
#[derive(Serialize)]
#[serde(rename_all = "snake_case")]
enum Part<T> {
    There(T),
    Absent(Absent),
}

/// Takes what is missing for want of runs or of an OpenGL driver as a part that isn't there.
///
/// # Errors
/// When it failed for any other reason.
fn part<T>(outcome: Result<T, FigureError>) -> Result<Part<T>, FigureError> {
    let (reason, command) = match outcome {
        Ok(part) => return Ok(Part::There(part)),
        Err(FigureError::NoRuns { experiment, command, .. }) => {
            (format!("There is no finished run of {experiment}."), Some(command))
        }
        Err(FigureError::NoRows { experiment, command, .. }) => {
            (format!("The finished runs of {experiment} lack what this shows."), Some(command))
        }
        Err(FigureError::Mixed(error)) => (sentence(&error.to_string()), None),
        Err(FigureError::Simulation(error @ SimulationError::NoRenderer { .. })) => {
            (format!("It could not be rendered: {error}."), None)
        }
        Err(error) => return Err(error),
    };
    Ok(Part::Absent(Absent { reason, command }))
}

/// A message as a sentence.
fn sentence(text: &str) -> String {
    let (first, rest) = text.split_at(1);
    format!("{}{rest}.", first.to_uppercase())
}

/// What `of_study` makes of the runs of both studies, and the studies without runs.
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

/// What the page's template is filled with.
#[derive(Serialize)]
struct Page {
    style: &'static str,
    script: &'static str,
    policy: String,
    quick: bool,
    /// The command that makes some runs in seconds.
    smoke: String,
    /// How many runs are done.
    done: usize,
    /// The commands that make what isn't there.
    commands: BTreeSet<String>,
    /// Which runs were left out, and which can't be put together.
    remarks: Vec<String>,
    clips: Part<Vec<clips::Clip>>,
    verdicts: verdicts::Verdicts,
    readings: Part<readings::Readings>,
    figures: Vec<figures::Drawn>,
    experiments: Vec<runs::Experiment>,
    /// What isn't there of the results by joint and link, and of the regression.
    joints_absent: BTreeSet<Absent>,
    regression_absent: BTreeSet<Absent>,
    has: Has,
    /// [`Data`] as JSON.
    data: String,
}

/// Which of the script's data there are.
#[derive(Serialize)]
struct Has {
    joints: bool,
    regression: bool,
    training: bool,
}

/// What the page's script draws and plays.
#[derive(Serialize)]
struct Data {
    clips: Vec<clips::Frames>,
    joints: Vec<joints::Series>,
    regression: Vec<regression::Cloud>,
    training: Vec<training::Curves>,
}

/// Makes the page of a results folder: an HTML document.
///
/// # Arguments
/// * `claims` the statements to judge
/// * `readings` the experiment with the readings under which they are judged too
/// * `settings` what the runs' settings must be
/// * `quick` whether claims, figures and results are those of the runs with `--quick`
///
/// # Errors
/// When a table is damaged or doesn't hold what it should, or a claim's query is wrong. Missing runs and a missing
/// OpenGL driver are no errors.
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
    let figures = figures::draw(&source, progress)?;
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
    // A name that the template has and the page lacks is an error.
    templates.set_undefined_behavior(UndefinedBehavior::SemiStrict);
    // By the ending of its name, text is escaped for HTML.
    templates.add_template("page.html", TEMPLATE)?;
    templates.get_template("page.html")?.render(Serde(page))
}

/// JSON that can stand in a `script` element: no text in it can end the element or open another.
fn script_safe(json: &str) -> String {
    json.replace('<', "\\u003c")
}

/// What browsers may do with the page: show its pictures, apply its style and run its script, which they know by its
/// SHA-256. Text that gets past the escaping can't run, and nothing is loaded from anywhere.
fn policy() -> String {
    let digest = |text: &str| format!("'sha256-{}'", BASE64.encode(Sha256::digest(text)));
    format!(
        "default-src 'none'; img-src data:; style-src {}; script-src {}; base-uri 'none'; form-action 'none'",
        digest(STYLE),
        digest(SCRIPT)
    )
}

/// Five significant digits: what a picture can show, at half the size.
fn short(value: f64) -> f64 {
    format!("{value:.4e}").parse().unwrap_or(value)
}
