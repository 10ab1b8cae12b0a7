//! Makes the report: an HTML page with scenes, claims, figures, charts, training curves and runs.
//!
//! The page is about all results, or about some experiments ([`Asked`]). A page of some experiments has parts that
//! know any robot: what it senses, its metrics beside baselines, predictions along an episode, and images. It is one
//! self-contained HTML document, so it can be opened from a disk and sent by mail. Where runs are missing, the page
//! names the command that makes them. The same tables give the same bytes.
//!
//! `page.html` is the template. minijinja escapes every value in it that isn't marked as `safe`. `page.css` and
//! `page.js` are inserted unchanged, after the style and the script of the charts. A content security policy lets
//! browsers run only this script and load no file.

mod cache;
mod clips;
mod course;
mod dataset;
mod figures;
mod horizon;
mod images;
mod joints;
mod means;
mod modalities;
mod predictions;
mod regression;
mod runs;
mod subjects;
mod training;
mod verdicts;

pub use dataset::dataset_page;

use base64::Engine;
use base64::engine::general_purpose::STANDARD as BASE64;
use clips::Shot;
use harness_analysis::{Analysis, AnalysisError, Selection, Setting, has_settings};
use harness_catalog::QueryError;
use harness_claims::{self as claims, Claim, ClaimsError, ClaimsFile};
use harness_figures::source::{Experiments, Source};
use harness_figures::{FORCES_SQL, FigureError, OfReading, Shown};
use harness_registry::dataset::DatasetError;
use harness_registry::{Registry, RunRecord, Status, quoted};
use harness_shared::progress::Progress;
use harness_simulation::SimulationError;
use harness_spec::{QUICK, Scenario, SpecError};
use minijinja::value::Serde;
use minijinja::{Environment, UndefinedBehavior};
use serde::Serialize;
use sha2::{Digest, Sha256};
use std::collections::BTreeSet;
use std::sync::LazyLock;

const TEMPLATE: &str = include_str!("page.html");
/// The style sheet of the page.
static STYLE: LazyLock<String> =
    LazyLock::new(|| [harness_charts::STYLE, include_str!("page.css")].join("\n"));
/// The script of the page.
static SCRIPT: LazyLock<String> =
    LazyLock::new(|| [harness_charts::SCRIPT, include_str!("page.js")].join("\n"));

/// Why the page can't be made.
#[derive(Debug, thiserror::Error)]
pub enum ReportError {
    /// A figure can't be drawn although its runs exist, or a table can't be read.
    #[error(transparent)]
    Figure(#[from] FigureError),
    /// A claim can't be judged, for example because its query is wrong.
    #[error(transparent)]
    Claims(#[from] ClaimsError),
    /// The spec of the readings that the claims name is invalid.
    #[error(transparent)]
    Spec(#[from] SpecError),
    /// The runs can't be selected.
    #[error(transparent)]
    Analysis(#[from] AnalysisError),
    /// A table of losses can't be read.
    #[error(transparent)]
    Query(#[from] QueryError),
    /// The template can't be rendered.
    #[error("the page can't be put together: {0}")]
    Page(#[from] minijinja::Error),
    /// A dataset can't be read.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// A picture can't be encoded.
    #[error("a picture can't be written: {0}")]
    Picture(#[from] image::ImageError),
    /// The data for the page's script can't be written as JSON.
    #[error("the page's data can't be written: {0}")]
    Data(#[from] serde_json::Error),
}

/// Why a part of the page is missing, and the command that makes its runs.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize)]
struct Absent {
    reason: String,
    command: Option<String>,
    /// Whether the runs of an asked experiment do not have the part.
    lacks_rows: bool,
}

/// A part of the page, or the reason why it is missing.
#[derive(Serialize)]
#[serde(rename_all = "snake_case")]
enum Part<T> {
    There(T),
    Absent(Absent),
}

/// Converts the result of making a part. If the part failed because runs are missing, because runs differ in their
/// settings, or because there is no OpenGL driver, it becomes [`Part::Absent`]. If the runs of an asked experiment do
/// not have the part, there is no command, because the experiment's spec may not ask for it and may be in any file.
///
/// # Errors
/// When the part failed for any other reason.
fn part<T>(outcome: Result<T, FigureError>, asked: &Asked) -> Result<Part<T>, FigureError> {
    let lacks_rows = !asked.experiments.is_empty() && matches!(outcome, Err(FigureError::NoRows { .. }));
    let (reason, command) = match outcome {
        Ok(part) => return Ok(Part::There(part)),
        Err(FigureError::NoRuns { experiment, command, .. }) => {
            (format!("There is no finished run of {experiment}."), command)
        }
        Err(FigureError::NoRole { experiment, reading, role, command, .. }) => {
            let of = format!("{experiment} under the reading {reading} in the role {role}");
            (format!("There is no finished run of {of}."), command)
        }
        Err(FigureError::NoRows { experiment, there, command, .. }) => {
            let reason = format!("The finished runs of {experiment} ({there}) have no rows for this part.");
            (reason, command.filter(|_| !lacks_rows))
        }
        Err(FigureError::Mixed(error)) => (sentence(&error.to_string()), None),
        Err(FigureError::Simulation(error @ SimulationError::NoRenderer(_))) => {
            (format!("It could not be rendered: {error}."), None)
        }
        Err(error) => return Err(error),
    };
    Ok(Part::Absent(Absent { reason, command, lacks_rows }))
}

/// Makes a message a sentence: with a capital letter and a full stop.
fn sentence(text: &str) -> String {
    let (first, rest) = text.split_at(1);
    format!("{}{rest}.", first.to_uppercase())
}

/// What a page is about.
#[derive(Debug, Clone, Default)]
pub struct Asked {
    /// The experiments, as `harness ls` names them. Empty for all results.
    pub experiments: Vec<String>,
    /// The settings that runs must have to be used.
    pub settings: Vec<Setting>,
    /// Whether claims, figures and results use the runs made with `--quick`.
    pub quick: bool,
}

impl Asked {
    /// The same without repeated names of experiments. If there is no name and no experiment of the paper has runs, the
    /// page is about all others, because it would have nothing about the paper.
    fn resolved(&self, others: &Others) -> Self {
        let mut known = BTreeSet::new();
        let mut experiments: Vec<String> =
            self.experiments.iter().filter(|name| known.insert(*name)).cloned().collect();
        if experiments.is_empty() && !others.is_beside_the_paper {
            experiments.extend(others.experiments.iter().cloned());
        }
        Self { experiments, ..self.clone() }
    }

    /// Whether the page is about this experiment.
    fn has(&self, experiment: &String) -> bool {
        self.experiments.is_empty() || self.experiments.contains(experiment)
    }

    /// Whether the page is about this run.
    fn has_run(&self, run: &RunRecord) -> bool {
        self.has(&run.experiment) && has_settings(run, &self.settings)
    }

    /// Whether the page is about quick runs.
    fn is_quick(&self) -> bool {
        let is_named =
            !self.experiments.is_empty() && self.experiments.iter().all(|name| name.ends_with(QUICK));
        self.quick || is_named
    }

    /// The claims that runs of these experiments decide.
    fn claims<'a>(&self, all: &'a [Claim]) -> Vec<&'a Claim> {
        let is_decided =
            |claim: &&Claim| claim.experiments(self.is_quick()).iter().all(|name| self.has(name));
        all.iter().filter(is_decided).collect()
    }

    /// The runs that count, which the claims and the figures need too.
    fn analysis(
        &self,
        registry: &Registry,
        claims: &[&Claim],
        reading: Option<&OfReading>,
    ) -> Result<Analysis, AnalysisError> {
        let quick = self.is_quick();
        let analysis = if self.experiments.is_empty() {
            let mut selection = claims::selection(claims, &self.settings, quick);
            let of_reading = reading.map(|reading| reading.experiment().to_owned());
            let of_the_paper = Experiments::of_the_paper(quick).names().into_iter().chain(of_reading);
            let of_the_paper: Vec<String> = of_the_paper.collect();
            selection.experiments.extend(of_the_paper.iter().cloned());
            selection.trained.extend(of_the_paper);
            Analysis::new(registry, &selection)?
        } else {
            Analysis::finished(registry, &self.experiments, &self.settings)?;
            // The charts and figures are about networks, except claims that name the variant, and experiments that
            // have none.
            let of_claims = claims::selection(claims, &self.settings, quick);
            let records = registry.records();
            let has_network =
                |name: &str| records.iter().any(|run| run.experiment == name && run.spec.trained().is_some());
            let is_of_networks = |name: &&String| {
                has_network(name.as_str())
                    && (!of_claims.experiments.contains(name) || of_claims.trained.contains(name))
            };
            let trained = self.experiments.iter().filter(is_of_networks).cloned().collect();
            let (experiments, settings) = (self.experiments.clone(), self.settings.clone());
            Analysis::new(registry, &Selection { experiments, settings, trained, ..Selection::default() })?
        };
        Ok(claims::expect(analysis, claims, quick).expect([joints::SQL, FORCES_SQL]))
    }
}

/// The experiments that a page without a name does not show, because they do not test the paper's statements.
struct Others {
    /// Those with finished runs.
    experiments: BTreeSet<String>,
    /// Whether experiments of the paper have finished runs.
    is_beside_the_paper: bool,
}

impl Others {
    fn of(registry: &Registry, paper: &BTreeSet<String>) -> Self {
        let is_done = |record: &RunRecord| record.status == Status::Done;
        let names = registry.records().into_iter().filter(is_done).map(|record| record.experiment);
        let (own, experiments): (BTreeSet<String>, _) = names.partition(|name| paper.contains(name));
        Self { experiments, is_beside_the_paper: !own.is_empty() }
    }

    /// The commands that make a page of each, if there are any.
    fn commands(&self, registry: &Registry) -> Vec<String> {
        let command = |name: &String| registry.command(&format!("report {}", quoted([name.as_str()])));
        self.experiments.iter().map(command).collect()
    }
}

/// The values that the page's template uses.
#[derive(Serialize)]
struct Page {
    style: &'static str,
    script: &'static str,
    policy: String,
    /// The experiments that the page is about; empty if it is about all results.
    asked: Vec<String>,
    quick: bool,
    /// The command that makes some runs in seconds.
    smoke: String,
    /// The number of runs that are done.
    done: usize,
    /// The commands that make the missing runs.
    commands: BTreeSet<String>,
    /// Notes about runs that were left out, and about runs whose settings differ.
    remarks: Vec<String>,
    clips: Vec<Part<clips::Clip>>,
    /// On a page of all results, the commands that make pages of the experiments that it does not show.
    others: Vec<String>,
    /// What the worlds of the asked experiments sense.
    worlds: Vec<modalities::World>,
    /// The metrics of the asked experiments.
    means: Vec<means::Table>,
    images: Vec<images::Images>,
    images_absent: BTreeSet<Absent>,
    /// Why predictions along an episode are missing.
    course_absent: BTreeSet<Absent>,
    verdicts: verdicts::Verdicts,
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

/// Whether runs are in the paper's scenes, and whether the script has data for each of its charts.
#[derive(Serialize)]
struct Has {
    scenes: bool,
    joints: bool,
    /// Whether elements are the joints and links of a finger.
    finger: bool,
    course: bool,
    horizon: bool,
    /// Whether networks predict further than the next sample, which most charts show.
    further: bool,
    regression: bool,
    training: bool,
}

/// The data of the charts and clips for the page's script.
#[derive(Serialize)]
struct Data {
    clips: Vec<clips::Frames>,
    joints: Vec<joints::Series>,
    regression: Vec<regression::Cloud>,
    course: Vec<course::Course>,
    horizon: Vec<horizon::Curve>,
    training: Vec<training::Curves>,
}

/// Makes the page of a results folder and returns it as an HTML document.
///
/// # Arguments
/// * `registry`: the runs of the results folder
/// * `file`: the statements to judge. On a page of all results, they are also judged by the readings that it names
/// * `asked`: the experiments and runs that the page is about
/// * `progress`: shows how far the work is
///
/// # Errors
/// When an asked experiment has no finished runs, a table is damaged or has unexpected columns, or a claim's query is
/// wrong. Other missing runs and a missing OpenGL driver are no errors.
pub fn page(
    registry: &Registry,
    file: &ClaimsFile,
    asked: &Asked,
    progress: &dyn Progress,
) -> Result<String, ReportError> {
    let spec_of_readings = file.spec_of_readings(registry, asked.quick)?;
    let of_claims = file.claims.iter().flat_map(|claim| claim.experiments(asked.quick));
    let of_readings = spec_of_readings.iter().map(|spec| spec.name.clone());
    let of_figures = Experiments::of_the_paper(asked.quick).all();
    let paper = of_figures.into_iter().chain(of_claims).chain(of_readings).collect();
    let others = Others::of(registry, &paper);
    let asked = &asked.resolved(&others);
    let claims = asked.claims(&file.claims);
    let quick = asked.is_quick();
    let reading = match asked.experiments.is_empty() {
        true => Shown { quick, ..Shown::default() }.or_reproduction(registry)?.reading,
        false => None,
    };
    let analysis = asked.analysis(registry, &claims, reading.as_ref())?;
    let studies = subjects::studies(&analysis, asked, reading.as_ref());
    let scenarios = subjects::scenarios(&analysis, asked);
    let source = Source::new(&analysis, studies).under(reading.as_ref());
    let (subjects, too_many) = subjects::subjects(&source, asked);
    let figures = figures::render(&source, asked, !scenarios.is_empty(), progress)?;
    let is_about_all = asked.experiments.is_empty() && asked.settings.is_empty();
    let families = spec_of_readings.filter(|_| is_about_all);
    let verdicts = verdicts::Verdicts::of(registry, &analysis, &claims, families.as_ref(), quick)?;
    let experiments = runs::experiments(registry, asked);
    let (clips, frames) = clips(&scenarios, &analysis, asked, progress)?;
    let (joints, joints_absent) = joints::series(&source, &subjects, asked)?;
    let (regression, regression_absent) = regression::clouds(&source, &subjects, asked)?;
    let ((course, course_absent), (images, images_absent)) = match asked.experiments.is_empty() {
        true => Default::default(),
        false => (course::courses(&source, &subjects, asked)?, images::images(&source, &subjects, asked)?),
    };
    // Tables and curves tell models of other programs from networks.
    let of_all_models = match asked.experiments.is_empty() {
        true => None,
        false => Some(Analysis::finished(registry, &asked.experiments, &asked.settings)?),
    };
    let of_all_models = of_all_models.as_ref().unwrap_or(&analysis);
    let means = means::tables(of_all_models, asked)?;
    let horizon = horizon::curves(of_all_models, asked)?;
    let training = training::curves(registry, asked)?;
    let data = Data { clips: frames, joints, regression, course, horizon, training };

    let undrawn = figures.iter().filter_map(|figure| match &figure.svg {
        Part::Absent(absent) => Some(absent),
        Part::There(_) => None,
    });
    let absent = undrawn.chain(&joints_absent).chain(&regression_absent).chain(&course_absent);
    let commands = absent.filter_map(|absent| absent.command.clone()).chain(verdicts.commands.clone());
    // No run is added to published results.
    let commands = commands.filter(|_| !analysis.is_published()).collect();
    let page = Page {
        style: &STYLE,
        script: &SCRIPT,
        policy: policy(),
        asked: asked.experiments.clone(),
        quick,
        smoke: registry.command("run smoke"),
        done: experiments.iter().map(|experiment| experiment.done).sum(),
        commands,
        remarks: analysis
            .notes()
            .iter()
            .chain(&verdicts.mixed)
            .chain(&too_many)
            .map(|text| sentence(text))
            .collect(),
        has: Has {
            scenes: !clips.is_empty(),
            joints: !data.joints.is_empty(),
            finger: data.joints.iter().any(joints::Series::is_of_finger),
            course: !data.course.is_empty(),
            horizon: !data.horizon.is_empty(),
            further: analysis.predicts_further(),
            regression: !data.regression.is_empty(),
            training: !data.training.is_empty(),
        },
        clips,
        others: if asked.experiments.is_empty() { others.commands(registry) } else { Vec::new() },
        worlds: modalities::worlds(&analysis, asked),
        means,
        images,
        images_absent,
        course_absent,
        verdicts,
        figures,
        experiments,
        joints_absent,
        regression_absent,
        data: script_safe(&serde_json::to_string(&data)?),
    };
    Ok(rendered("page.html", TEMPLATE, &page)?)
}

/// Films the scenes of the paper that the page is about, and the other worlds of the asked experiments. A world that
/// can't be filmed becomes [`Part::Absent`]. Without an OpenGL driver, one part says so.
fn clips(
    scenarios: &[Scenario],
    analysis: &Analysis,
    asked: &Asked,
    progress: &dyn Progress,
) -> Result<(Vec<Part<clips::Clip>>, Vec<clips::Frames>), FigureError> {
    let own = scenarios.iter().map(|scenario| (Shot::of_the_paper(*scenario), true));
    let others = Shot::others(analysis, asked).into_iter().map(|shot| (shot, false));
    let (mut clips, mut frames, mut absent) = (Vec::new(), Vec::new(), BTreeSet::new());
    for (shot, is_of_the_paper) in own.chain(others) {
        match part(clips::film(&shot, progress), asked) {
            Ok(Part::Absent(reason)) => drop(absent.insert(reason)),
            Ok(Part::There((clip, pictures))) => {
                clips.push(Part::There(clip));
                frames.push(pictures);
            }
            Err(error) if is_of_the_paper => return Err(error),
            // The world's files may be gone, or have changed since the runs.
            Err(error) => {
                let reason = format!("The world {} could not be filmed: {error}.", shot.scenario);
                absent.insert(Absent { reason, command: None, lacks_rows: false });
            }
        }
    }
    clips.extend(absent.into_iter().map(Part::Absent));
    Ok((clips, frames))
}

/// Renders a page with a template, whose name ends in `.html`.
fn rendered(name: &str, template: &str, page: &impl Serialize) -> Result<String, minijinja::Error> {
    let mut templates = Environment::new();
    // A name in the template that the page doesn't define is an error.
    templates.set_undefined_behavior(UndefinedBehavior::SemiStrict);
    // minijinja escapes text for HTML because the template's name ends in `.html`.
    templates.add_template(name, template)?;
    templates.get_template(name)?.render(Serde(page))
}

/// Escapes JSON for a `script` element, so that no text in it can end the element or open another one.
fn script_safe(json: &str) -> String {
    json.replace('<', "\\u003c")
}

/// The page's content security policy. It allows the pictures in the page, and the page's own style and script by their
/// SHA-256. Injected text can't run as a script, and browsers load no other file.
fn policy() -> String {
    format!("{}; script-src {}", style_policy(), digest(&SCRIPT))
}

/// The content security policy of a page without a script.
fn style_policy() -> String {
    let style = digest(&STYLE);
    format!("default-src 'none'; img-src data:; style-src {style}; base-uri 'none'; form-action 'none'")
}

/// The SHA-256 of a style sheet or a script, as a content security policy has it.
fn digest(text: &str) -> String {
    format!("'sha256-{}'", BASE64.encode(Sha256::digest(text)))
}

/// Rounds to five significant digits. A chart can't show more, and the page's data are half as large.
fn short(value: f64) -> f64 {
    rounded(value, 5)
}

/// Rounds to so many significant digits.
fn rounded(value: f64, digits: usize) -> f64 {
    format!("{value:.*e}", digits - 1).parse().unwrap_or(value)
}
