//! What a person can ask of results, as one value, and its answer.

use super::rows::Row;
use super::skill::{skill_horizons, skills};
use super::undefined::undefined;
use super::{Analysis, AnalysisError, Answer, Key, Labels, Mean, Over, Run, Setting, predicted, usual_key};
use harness_catalog::{OVERALL, QueryError, rows};
use harness_judge::models::{self, baselines_in_sql};
use harness_metrics::Metric;
use harness_registry::Registry;
use harness_shared::meant;
use harness_shared::numbers::counted;
use harness_spec::{Modality, RunSpec, Task, is_axis, model_parts};
use harness_sql::text_in_sql;
use harness_tables::schema::{GIVEN, HORIZON, Table};
use polars::prelude::DataFrame;
use serde::Deserialize;
use std::collections::{BTreeSet, HashMap};
use std::fmt;
use std::str::FromStr;

/// The metrics that are answered if none is asked for.
const USUAL: [Metric; 8] = [
    Metric::Smape,
    Metric::Wmape,
    Metric::R2,
    Metric::RelativeError,
    Metric::Accuracy,
    Metric::BalancedAccuracy,
    Metric::LogLoss,
    Metric::Angle,
];
/// The metrics that are answered instead if no run has one of those. They are always defined.
const ALWAYS_DEFINED: [Metric; 2] = [Metric::Rmse, Metric::Mae];

/// How far ahead a prediction is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Horizon {
    /// A number of samples.
    Samples(usize),
    /// A time, s.
    Seconds(f64),
}

impl FromStr for Horizon {
    type Err = String;

    /// Reads a number of samples (`5`) or a time in seconds (`0.5s`).
    fn from_str(text: &str) -> Result<Self, String> {
        let horizon = match text.strip_suffix('s') {
            Some(seconds) => {
                seconds.parse().ok().filter(|time| *time > 0.0 && *time < 1e9).map(Self::Seconds)
            }
            None => text.parse().ok().map(Self::Samples),
        };
        horizon.ok_or_else(|| "write a number of samples, or a time in seconds, such as 0.5s".into())
    }
}

impl fmt::Display for Horizon {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Self::Samples(samples) => f.write_str(&counted(*samples, "sample")),
            Self::Seconds(seconds) => write!(f, "{seconds} s"),
        }
    }
}

impl Horizon {
    /// The number of samples of a run that this is. `None` if it is a time between two samples, or if the run is on
    /// imported data, whose rate its record does not have.
    fn samples(self, run: &RunSpec) -> Option<usize> {
        match self {
            Self::Samples(samples) => Some(samples),
            Self::Seconds(seconds) => {
                let samples = seconds * run.simulation.as_ref()?.sample_rate_hz;
                ((samples - samples.round()).abs() < 1e-6).then_some(samples.round() as usize)
            }
        }
    }
}

/// Everything that a person can ask of the results of runs. Each field is an option of the command line and an argument
/// in Python. The default asks for the usual metrics of all runs.
#[derive(Debug, Clone, Default)]
pub struct Question {
    /// The names of the experiments, as `harness ls` lists them. Empty for all experiments.
    pub experiments: Vec<String>,
    /// The settings that the runs must have. Several values of one setting are alternatives.
    pub settings: Vec<Setting>,
    /// The task that is evaluated; `None` for both.
    pub task: Option<Task>,
    /// The predicted modalities, or parts of them with one unit (`joints in rad`). Empty for all of them.
    pub of: Vec<String>,
    /// The names of the metrics. Empty for the main ones.
    pub metrics: Vec<String>,
    /// The models: [`NETWORK`](models::NETWORK), which stands for all models but baselines and untrained
    /// encoders, and names of models. Empty for all of them.
    pub models: Vec<String>,
    /// How far ahead the predictions are. If there are none, they are as far ahead as the spec of each run says
    /// (`window.horizon`), or at every horizon if [`Key::Horizon`] tells means apart.
    pub horizons: Vec<Horizon>,
    /// The modalities that the models got, joined by a comma, if they got only some of a run's inputs. If there are none,
    /// the models got all, or whatever they were tested with if [`Key::Given`] tells means apart.
    pub given: Option<String>,
    /// The keys that tell columns apart. If there are none, it is [`usual_key`].
    pub by: Vec<Key>,
    /// The heading of a column. The other columns are differences from it.
    pub against: Option<String>,
    /// What the intervals are to contain.
    pub over: Over,
}

/// The name of a set of inputs in [`Question::given`] and in tables: in alphabetical order, with commas between them.
/// `text` may have them in any order, with commas or plus signs.
pub fn name_of_given(text: &str) -> String {
    let names: BTreeSet<&str> = text.split(['+', ',']).map(str::trim).collect();
    Vec::from_iter(names).join(",")
}

impl Question {
    /// Answers the question about the runs of a results folder.
    ///
    /// # Errors
    /// When the runs can't be selected, no run has what is asked for, or a table is damaged.
    pub fn ask(&self, registry: &Registry) -> Result<Answer, AnalysisError> {
        self.answer(&Analysis::finished(registry, &self.experiments, &self.settings)?)
    }

    /// Answers the question about runs that were selected before.
    ///
    /// # Errors
    /// When no run has what is asked for, or a table is damaged.
    pub fn answer(&self, analysis: &Analysis) -> Result<Answer, AnalysisError> {
        if analysis.experiments().next().is_none() {
            return Err(AnalysisError::Nothing(analysis.registry.command("run single_to_multi")));
        }
        if self.against.is_some() && self.by.contains(&Key::Scenario) {
            return Err(AnalysisError::Unanswerable(
                "--against compares runs on the same data, and each scenario has its own; choose one with --where \
                 scenario=NAME, and leave scenario out"
                    .to_owned(),
            ));
        }
        self.check_models(analysis)?;
        self.check_axes(analysis)?;
        self.check_given(analysis)?;
        let table = self.read(analysis)?;
        let mut rows = self.rows(analysis, &table)?;
        rows.extend(skills(&rows));
        let undefined = undefined(analysis, &rows, &self.of);
        let mut means = analysis.means_of(&rows, &self.by, self.over)?;
        if self.metrics.iter().any(|name| name == Metric::SkillHorizon.name()) {
            let errors = self.with_all_horizons();
            let table = errors.read(analysis)?;
            let rows = errors.rows(analysis, &table)?;
            means.extend(analysis.means_of(&skill_horizons(&skills(&rows)), &self.by, self.over)?);
        }
        self.check_names(analysis, &means)?;
        let metrics = self.chosen_metrics(&means);
        let undefined = undefined.sentences(|name| match self.metrics.as_slice() {
            [] => USUAL.iter().any(|metric| metric.name() == name),
            asked => asked.iter().any(|metric| metric == name),
        });
        means.retain(|mean| metrics.contains(&mean.of.metric) && self.wants(mean));
        if means.is_empty() {
            let list = "query \"select distinct experiment, task, model, modality, metric from metrics\"";
            let list = analysis.registry.command(list);
            let reasons: String = undefined.iter().map(|reason| format!("{reason}; ")).collect();
            return Err(AnalysisError::NoMeans(format!(
                "{reasons}no run has these metrics for this task, model, modality and horizon; `{list}` lists those that \
                 runs have"
            )));
        }
        let by = if self.by.is_empty() { vec![usual_key(&means)] } else { self.by.clone() };
        let notes = undefined.into_iter().chain(analysis.notes().iter().cloned()).collect();
        let mut answer = Answer {
            by,
            metrics,
            labels: Labels::new(analysis, &self.by),
            sample_rate_hz: analysis.sample_rate_hz(),
            against: None,
            cells: means,
            notes,
        };
        if let Some(base) = &self.against {
            answer.subtract(base)?;
        }
        Ok(answer)
    }

    /// The question whose rows are the errors at all horizons.
    fn with_all_horizons(&self) -> Self {
        Self {
            metrics: vec![Metric::Rmse.name().to_owned()],
            by: std::iter::once(Key::Horizon)
                .chain(self.by.iter().copied().filter(|key| *key == Key::Given))
                .collect(),
            horizons: Vec::new(),
            ..self.clone()
        }
    }

    /// The metrics that are asked for. If none is, they are the main ones or, without any, those that are always defined.
    fn chosen_metrics(&self, means: &[Mean]) -> Vec<String> {
        let names =
            |metrics: &[Metric]| metrics.iter().map(|metric| metric.name().to_owned()).collect::<Vec<_>>();
        if !self.metrics.is_empty() {
            return self.metrics.clone();
        }
        let usual = names(&USUAL);
        let is_there = means.iter().any(|mean| usual.contains(&mean.of.metric) && self.wants(mean));
        if is_there { usual } else { names(&ALWAYS_DEFINED) }
    }

    /// Whether a mean is of a wanted task, model and modality.
    fn wants(&self, mean: &Mean) -> bool {
        (self.models.is_empty() || self.models.iter().any(|model| mean.of.is_by(model)))
            && (self.of.is_empty() || self.of.iter().any(|name| mean.of.is_of(name)))
            && self.task.is_none_or(|task| task == mean.of.task)
    }

    /// The horizons, in samples, at which a run's predictions are asked for.
    fn horizons_of(&self, run: &RunSpec) -> Vec<usize> {
        match self.horizons.as_slice() {
            [] => vec![run.window.horizon],
            chosen => chosen.iter().filter_map(|horizon| horizon.samples(run)).collect(),
        }
    }

    /// Whether predictions at every horizon are asked for.
    fn is_about_all_horizons(&self) -> bool {
        self.horizons.is_empty() && self.by.contains(&Key::Horizon)
    }

    /// Reads the tables of metrics as far as they are asked for, also rows without a value.
    fn read(&self, analysis: &Analysis) -> Result<DataFrame, QueryError> {
        let experiments: Vec<&str> = analysis.experiments().filter(|name| self.is_about(name)).collect();
        let runs = experiments.iter().flat_map(|name| analysis.runs(name));
        let horizons: BTreeSet<usize> = runs.flat_map(|run| self.horizons_of(&run.record.spec)).collect();
        let is_every = self.is_about_all_horizons();
        let is_of_all_inputs = self.given.is_none() && !self.by.contains(&Key::Given);
        let is_next = !is_every && is_of_all_inputs && horizons.iter().all(|samples| *samples == 1);
        let mut conditions = vec![OVERALL.to_owned(), format!("metric in ({})", self.read_metrics())];
        conditions.extend(self.task.map(|task| format!("task = '{}'", task.name())));
        if !is_next {
            conditions.extend(match &self.given {
                None => is_of_all_inputs.then(|| format!("{GIVEN} is null")),
                Some(given) => {
                    Some(format!("({GIVEN} = {} or model in ({}))", text_in_sql(given), baselines_in_sql()))
                }
            });
        }
        if !is_next && !is_every {
            let listed: String = horizons.iter().map(|samples| format!(", {samples}")).collect();
            conditions
                .push(format!("({HORIZON} in (0{listed}) or modality = '{}')", Modality::LATENT.name()));
        }
        let (table, horizon) = if is_next {
            (Table::Metrics, String::new())
        } else {
            (Table::AllMetrics, format!(", {HORIZON}, {GIVEN}"))
        };
        let sql = format!(
            "select experiment, run, task, model, modality, direction, metric, value, unit{horizon} from {} where {}",
            table.name(),
            conditions.join(" and ")
        );
        let mut answer = analysis.query(&experiments, &sql)?;
        answer.rechunk_mut();
        Ok(answer)
    }

    /// The rows of a table that are at the horizons that are asked for.
    fn rows<'a>(&self, analysis: &Analysis, table: &'a DataFrame) -> Result<Vec<Row<'a>>, AnalysisError> {
        let mut rows = Row::all(table).map_err(QueryError::Sql)?;
        self.check_horizons(analysis, &rows)?;
        if self.is_about_all_horizons() {
            return Ok(rows);
        }
        let runs = analysis.experiments().flat_map(|name| analysis.runs(name)).map(|run| &run.record);
        let wanted: HashMap<(&str, &str), Vec<usize>> =
            runs.map(|run| ((&*run.experiment, &*run.run), self.horizons_of(&run.spec))).collect();
        rows.retain(|row| match row.horizon {
            None => true,
            Some(0) if row.task == Task::Reconstruction => self.horizons.is_empty(),
            Some(samples) => wanted.get(&(row.experiment, row.run)).is_some_and(|own| own.contains(&samples)),
        });
        Ok(rows)
    }

    fn is_about(&self, experiment: &str) -> bool {
        self.experiments.is_empty() || self.experiments.iter().any(|name| name == experiment)
    }

    /// The names of the metrics that are read, as a list of SQL. The skill is computed from the RMSE where R2 or the
    /// relative error has a value, and a WMAPE without one says that what is predicted is 0.
    fn read_metrics(&self) -> String {
        let names: Vec<&str> = match self.metrics.as_slice() {
            [] => USUAL.iter().chain(&ALWAYS_DEFINED).map(|metric| metric.name()).collect(),
            metrics => metrics
                .iter()
                .map(String::as_str)
                .chain([Metric::Rmse, Metric::R2, Metric::RelativeError, Metric::Wmape].map(Metric::name))
                .collect(),
        };
        names.into_iter().map(text_in_sql).collect::<Vec<_>>().join(", ")
    }

    /// Returns an error if a horizon is asked for at which no run predicts.
    fn check_horizons(&self, analysis: &Analysis, rows: &[Row<'_>]) -> Result<(), AnalysisError> {
        let runs = || analysis.experiments().flat_map(|name| analysis.runs(name)).map(|run| &run.record.spec);
        let found: BTreeSet<usize> = rows.iter().filter_map(|row| row.horizon).collect();
        let is_among = |wanted: &Horizon, horizons: &BTreeSet<usize>| {
            runs().filter_map(|run| wanted.samples(run)).any(|samples| horizons.contains(&samples))
        };
        // The runs may predict there and lack the metric.
        let Some(wanted) = self.horizons.iter().find(|wanted| !is_among(wanted, &found)) else {
            return Ok(());
        };
        let horizons = analysis.horizons()?;
        match is_among(wanted, &horizons) {
            true => Ok(()),
            false => {
                let unit = if horizons.iter().eq([&1]) { "sample" } else { "samples" };
                let horizons = listed(&horizons);
                Err(AnalysisError::Unanswerable(format!(
                    "no run predicts {wanted} ahead; the runs predict {horizons} {unit} ahead"
                )))
            }
        }
    }

    /// Returns an error if a model is none of the harness, and no run is of a model of that name.
    fn check_models(&self, analysis: &Analysis) -> Result<(), AnalysisError> {
        let runs = analysis.experiments().flat_map(|name| analysis.runs(name));
        let external: BTreeSet<&str> =
            runs.filter_map(|run| model_parts(&run.record.spec.variant).1).collect();
        let known: Vec<&str> = models::ALL.into_iter().chain(external).collect();
        match self.models.iter().find(|wanted| !known.contains(&wanted.as_str())) {
            None => Ok(()),
            Some(wanted) => Err(AnalysisError::Unanswerable(format!(
                "there is no model '{wanted}'{}there are {}",
                meant(wanted, &known),
                known.join(", ")
            ))),
        }
    }

    /// Returns an error if a key is neither a setting nor the name of an axis of a run.
    fn check_axes(&self, analysis: &Analysis) -> Result<(), AnalysisError> {
        let runs = || analysis.experiments().flat_map(|name| analysis.runs(name));
        let is_of_no_run = |name: &&str| !runs().flat_map(Run::axes).any(|axis| axis == *name);
        let asked = self.by.iter().filter_map(|key| key.setting());
        let Some(wanted) = asked.filter(|name| is_axis(name)).find(is_of_no_run) else { return Ok(()) };
        let axes: BTreeSet<&str> = runs().flat_map(Run::axes).collect();
        let known: BTreeSet<&str> = runs().flat_map(Run::keys).chain(Key::ALL.map(Key::name)).collect();
        let meant = meant(wanted, &known.into_iter().collect::<Vec<_>>());
        let axes = if axes.is_empty() { "none".to_owned() } else { listed(&axes) };
        let keys = Key::ALL.map(Key::name).join(", ");
        Err(AnalysisError::Unanswerable(format!(
            "there is no key '{wanted}'{meant}allowed: {keys}, a setting, such as input or network.hidden, or an axis of \
             these runs: {axes}"
        )))
    }

    fn check_given(&self, analysis: &Analysis) -> Result<(), AnalysisError> {
        let Some(wanted) = &self.given else { return Ok(()) };
        let experiments: Vec<&str> = analysis.experiments().collect();
        let sql =
            format!("select distinct {GIVEN} from all_metrics where {GIVEN} is not null order by {GIVEN}");
        let table = analysis.query(&experiments, &sql)?;
        let known =
            table.column(GIVEN).and_then(|column| Ok(column.str()?.iter().flatten().map(str::to_owned)));
        let known: Vec<String> = known.map_err(QueryError::Sql)?.collect();
        if known.contains(wanted) {
            return Ok(());
        }
        let known = match known.as_slice() {
            [] => "all got all inputs".to_owned(),
            // The command line takes names with plus signs between them.
            known => {
                let known: Vec<String> = known.iter().map(|names| names.replace(',', "+")).collect();
                format!("some got only {}", known.join(", "))
            }
        };
        Err(AnalysisError::Unanswerable(format!("no model got only {wanted} of its run's inputs; {known}")))
    }

    /// Returns an error if a metric is none of the harness and no run has it as a user's own, or if no run predicts a
    /// modality.
    fn check_names(&self, analysis: &Analysis, means: &[Mean]) -> Result<(), AnalysisError> {
        let has = |name: &String| means.iter().any(|mean| mean.of.metric == *name);
        let metric = self.metrics.iter().find(|name| Metric::named(name).is_none() && !has(name));
        let of = self.of.iter().find(|name| !means.iter().any(|mean| mean.of.is_of(name)));
        // Other rows may have them.
        let there = if metric.or(of).is_some() { there(analysis)? } else { Vec::new() };
        if let Some(wanted) = metric.filter(|name| !there.iter().any(|one| one.metric == **name)) {
            let own = there.iter().map(|one| &*one.metric).filter(|name| Metric::named(name).is_none());
            let own: BTreeSet<&str> = own.collect();
            let all: Vec<&str> =
                own.iter().copied().chain(Metric::all().map(|metric| metric.name())).collect();
            let own: String = own.iter().map(|own| format!(", {own}")).collect();
            return Err(AnalysisError::Unanswerable(format!(
                "there is no metric '{wanted}'{}{}{own}",
                meant(wanted, &all),
                Metric::known()
            )));
        }
        let predicted = there.iter().filter(|one| one.modality != Modality::LATENT).map(There::predicted);
        let known: BTreeSet<String> = predicted.collect();
        let is_there =
            |name: &String| known.contains(name) || there.iter().any(|one| one.modality.name() == name);
        match of.filter(|name| !is_there(name)) {
            Some(wanted) => Err(AnalysisError::UnknownModality(format!(
                "no run predicts '{wanted}'{}they predict {}",
                meant(wanted, &known.iter().map(String::as_str).collect::<Vec<_>>()),
                listed(&known)
            ))),
            None => Ok(()),
        }
    }
}

impl Analysis {
    /// The metrics over all elements or pixels that pages show: those of the harness, and those that users added to runs.
    /// Metrics of a region or a kind of contact are left out.
    ///
    /// # Errors
    /// When a table is damaged.
    pub fn whole_metrics(&self) -> Result<Vec<String>, QueryError> {
        let of_categories = Metric::CATEGORY.into_iter().filter(|metric| metric.is_judgment());
        let of_harness = Metric::GENERAL.into_iter().chain([Metric::Skill]).chain(of_categories);
        let of_harness = of_harness.map(|metric| metric.name().to_owned());
        let own: BTreeSet<String> = there(self)?.into_iter().map(|one| one.metric).collect();
        Ok(of_harness.chain(own.into_iter().filter(|name| Metric::named(name).is_none())).collect())
    }
}

/// A metric of a modality or of a part of it that some run has.
#[derive(Deserialize)]
struct There {
    metric: String,
    modality: Modality,
    direction: Option<String>,
}

impl There {
    fn predicted(&self) -> String {
        predicted(self.modality, self.direction.as_deref())
    }
}

/// The items with commas between them.
fn listed<T: ToString>(items: &BTreeSet<T>) -> String {
    items.iter().map(T::to_string).collect::<Vec<_>>().join(", ")
}

/// The metrics that the runs of an analysis have.
fn there(analysis: &Analysis) -> Result<Vec<There>, QueryError> {
    let experiments: Vec<&str> = analysis.experiments().collect();
    let sql = format!("select distinct metric, modality, direction from metrics where {OVERALL}");
    rows(&mut analysis.query(&experiments, &sql)?)
}
