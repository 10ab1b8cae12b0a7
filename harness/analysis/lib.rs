//! Selects the runs that results are computed from, groups them, and computes means and intervals of each group.
//!
//! Claims, comparisons, figures, the report and the Python package all use this crate, so that they agree about the
//! same folder.
//!
//! - **A run counts** if it is done, has the requested settings, and was made by the newest revision of the method
//!   among those runs.
//! - **Runs form a group** if they differ only in their seed and the seed of their dataset. If the groups of an
//!   experiment differ in other settings than scenario, latent size and `variant`, these settings are either shown
//!   ([`Analysis::settings`]) or refused with an error that names them ([`Analysis::check_uniform`]).
//! - **A group's values** are those of its datasets and seeds. [`replicates`] says which values an interval is computed
//!   from.

mod answer;
mod episodes;
mod error;
mod interval;
mod key;
mod labels;
mod means;
mod question;
mod rows;
mod seen;
mod settings;
mod skill;
mod subset;
mod undefined;

pub use answer::{Answer, BY_UNIT, Comparison, Part, Place, SIGNIFICANT, Side, Subject, printed, usual_key};
pub use episodes::Jackknife;
pub use error::{AnalysisError, Mixed, finished};
pub use harness_judge::models;
pub use harness_metrics::higher_is_better;
pub use interval::{
    Estimate, Interval, LEVEL, Over, holm, interval, intervals, mean_interval, replicates,
    unpaired_replicates,
};
pub use key::Key;
pub use labels::{Label, Labels};
pub use means::{Mean, Of, replicates_of};
use means::{note_about_shared_test, predicted};
pub use question::{Horizon, Question, name_of_given};
pub use settings::{Difference, Setting, all_settings, differing, has_settings, varied_settings};
pub use subset::Subset;
pub use undefined::Undefined;

use harness_catalog::{QueryError, RunTable, answer, conditions, one_after_the_other, table};
use harness_registry::{Asked, Recorded, Registry, RunRecord, Status, forces_of};
use harness_shared::nearest;
use harness_spec::{Layout, Origin, QUICK, RunSpec, Scenario};
use harness_sql::{Condition, Query, implies};
use harness_tables::lazily;
use harness_tables::schema::Table;
use polars::prelude::*;
use rayon::prelude::*;
use seen::Seen;
use settings::{DATASET, Settings, VARIANT};
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

/// A selection of runs.
#[derive(Debug, Clone, Default)]
pub struct Selection {
    /// The names of the experiments, as `harness ls` lists them. Empty for all experiments.
    pub experiments: Vec<String>,
    /// The settings that the runs must have. If a setting is listed with several values, a run must have one of them.
    pub settings: Vec<Setting>,
    /// Whether runs on imported data are left out.
    pub simulated: bool,
    /// Experiments of which the runs of external models are left out, because what is asked about their networks does
    /// not tell them apart.
    pub trained: Vec<String>,
}

/// A run that counts.
#[derive(Debug, Clone)]
pub struct Run {
    /// The run's record.
    pub record: RunRecord,
    folder: PathBuf,
    settings: Arc<Settings>,
}

impl Run {
    /// Path of the run's folder.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// The names of the axes that the run has labels of.
    pub(crate) fn axes(&self) -> impl Iterator<Item = &str> {
        settings::axes(&self.settings)
    }

    /// The keys of the run's settings, and the names of its axes.
    pub(crate) fn keys(&self) -> impl Iterator<Item = &str> {
        settings::keys(&self.settings)
    }

    /// The run's value of a setting, also if it is a default that its record does not store.
    pub(crate) fn setting(&self, key: &str) -> &str {
        settings::value(&self.settings, key)
    }

    fn recorded(&self) -> (PathBuf, RunRecord) {
        (self.folder.clone(), self.record.clone())
    }
}

/// The runs of one experiment that count.
#[derive(Default)]
struct Experiment {
    /// Sorted by scenario, variant, latent size, settings and seed.
    runs: Vec<Run>,
    differences: Vec<Difference>,
}

/// The runs of a results folder that count, and their tables. Each table is read once for all expected queries.
pub struct Analysis {
    registry: Registry,
    selection: Selection,
    experiments: BTreeMap<String, Experiment>,
    /// By experiment, the last of the runs that are left out because their world has changed since.
    outdated: BTreeMap<String, RunRecord>,
    /// Messages about the runs that were left out.
    notes: Vec<String>,
    /// The rows that the expected queries see, by table and experiment.
    tables: Mutex<BTreeMap<(Table, String, bool), Seen>>,
    expected: Expected,
    /// The queries that were parsed so far, by their text.
    parsed: Mutex<BTreeMap<String, Arc<Query>>>,
}

/// The expected queries, and the rows that they see.
#[derive(Default)]
struct Expected {
    queries: Vec<Arc<Query>>,
    rows: BTreeMap<Table, BTreeSet<Condition>>,
}

impl Expected {
    /// Whether the expected queries see all rows of a table that `query` sees.
    fn sees(&self, query: &Query, table: Table) -> bool {
        let Some(rows) = self.rows.get(&table) else { return false };
        let seen = conditions(query, table);
        !seen.is_empty() && seen.iter().all(|condition| rows.iter().any(|wide| implies(condition, wide)))
    }
}

impl Analysis {
    /// Finds the runs of a selection that count.
    ///
    /// # Errors
    /// When no run has one of the requested settings, or its value.
    pub fn new(registry: &Registry, selection: &Selection) -> Result<Self, AnalysisError> {
        Self::of(registry, registry.recorded(), selection)
    }

    /// Finds the runs of a selection that count among those of a results folder that were read before.
    ///
    /// # Errors
    /// When no run has one of the requested settings, or its value.
    pub fn of(
        registry: &Registry,
        recorded: Vec<Recorded>,
        selection: &Selection,
    ) -> Result<Self, AnalysisError> {
        let is_wanted = |record: &RunRecord| {
            record.status == Status::Done
                && (selection.experiments.is_empty() || selection.experiments.contains(&record.experiment))
                && (!selection.simulated || matches!(record.spec.scenario, Origin::Simulated(_)))
                && (record.spec.trained().is_some() || !selection.trained.contains(&record.experiment))
        };
        let outdated = registry.outdated(&recorded);
        // A version that is asked for counts.
        let is_chosen = |record: &RunRecord| {
            let mut of_world = selection.settings.iter().filter(|setting| setting.is_of_world());
            of_world.any(|setting| setting.is_about(&record.experiment))
        };
        let recorded = recorded.into_par_iter().filter(|(_, record)| is_wanted(record));
        let (left_out, recorded): (Vec<_>, Vec<_>) =
            recorded.partition(|(_, record)| outdated.has(record) && !is_chosen(record));
        let mut left_out: Vec<RunRecord> = left_out.into_iter().map(|(_, record)| record).collect();
        left_out.sort_by(|a, b| a.started.cmp(&b.started));
        registry.leave_out_outdated(&outdated, &left_out);
        let recorded = recorded.into_par_iter();
        let with_settings = recorded.map(|(folder, record)| {
            let settings = Arc::new(settings::of(&record));
            Run { record, folder, settings }
        });
        let done: Vec<Run> = with_settings.collect();
        let finished: Vec<_> =
            done.iter().map(|run| (run.record.experiment.as_str(), &*run.settings)).collect();
        check_settings(&selection.settings, &finished, "finished run")?;
        let has_settings =
            |run: &Run| settings::meets(&selection.settings, &run.record.experiment, &run.settings);
        let (counted, notes) = newest(done.into_iter().filter(has_settings).collect());
        let mut experiments: BTreeMap<String, Experiment> = BTreeMap::new();
        for run in counted {
            experiments.entry(run.record.experiment.clone()).or_default().runs.push(run);
        }
        experiments.values_mut().for_each(Experiment::arrange);
        Ok(Self {
            registry: registry.clone(),
            selection: selection.clone(),
            experiments,
            outdated: left_out.into_iter().map(|record| (record.experiment.clone(), record)).collect(),
            notes,
            tables: Mutex::default(),
            expected: Expected::default(),
            parsed: Mutex::default(),
        })
    }

    /// Finds the finished runs of `experiments`, or of all experiments if there are none, that have these settings.
    ///
    /// # Errors
    /// When the runs can't be selected, or one of the experiments has no finished run.
    pub fn finished(
        registry: &Registry,
        experiments: &[String],
        settings: &[Setting],
    ) -> Result<Self, AnalysisError> {
        let (experiments, settings) = (experiments.to_vec(), settings.to_vec());
        let analysis = Self::new(registry, &Selection { experiments, settings, ..Selection::default() })?;
        analysis.check_finished(&analysis.selection.experiments)?;
        Ok(analysis)
    }

    /// Path of the results folder.
    pub fn root(&self) -> &Path {
        self.registry.root()
    }

    /// The command that makes the runs of the experiment `name` with the requested settings, as quick runs if `quick`.
    /// `None` if no spec of this name makes such runs. Published results are left as they are, so the command makes the
    /// runs in the usual results folder.
    pub fn command(&self, name: &str, quick: bool) -> Option<String> {
        let (asked, experiment) = self.asked(name, quick);
        self.command_of(&asked, &experiment)
    }

    /// What makes runs of the experiment `name` with the requested settings, and the name of the experiment of such
    /// runs.
    fn asked(&self, name: &str, quick: bool) -> (Asked, String) {
        let experiment = format!("{name}{}", if quick { QUICK } else { "" });
        let about = self.selection.settings.iter().filter(|setting| setting.is_about(&experiment));
        let overrides = about.filter_map(Setting::as_override).collect();
        (Asked { spec: name.into(), overrides, quick }, experiment)
    }

    /// The commands that make runs like those of the experiment `name` in a scenario, or in all of them, but with other
    /// values of the settings `varied`: one for all runs that were made with the same settings. None if no spec makes
    /// such runs.
    pub fn commands_like(
        &self,
        name: &str,
        quick: bool,
        scenario: Option<Scenario>,
        varied: &[(&str, String)],
    ) -> BTreeSet<String> {
        let (requested, experiment) = self.asked(name, quick);
        let is_varied = |text: &String| varied.iter().any(|(key, _)| text.starts_with(&format!("{key}=")));
        let runs = self.runs(&experiment).iter();
        let runs = runs.filter(|run| scenario.is_none_or(|of| run.record.spec.scenario == Origin::from(of)));
        let asked = |run: &Run| {
            let mut asked = Asked::of(&run.record.provenance.command).unwrap_or_else(|| requested.clone());
            asked.overrides.retain(|text| !is_varied(text));
            asked
        };
        let command = |asked: Asked| {
            // The spec of a built-in experiment is found by its name everywhere.
            let by_name = Asked { spec: name.into(), ..asked.clone() };
            let (mut asked, made) = [asked, by_name, requested.clone()]
                .into_iter()
                .find_map(|asked| made_by(&asked, &experiment).map(|made| (asked, made)))?;
            let own = made.scenarios.iter().find(|own| scenario.is_some_and(|of| own.name() == of.name()));
            if let Some(own) = own {
                let own = match own {
                    Origin::File(path) => serde_json::to_string(path).ok()?,
                    other => other.name().to_owned(),
                };
                asked.overrides.retain(|text| !text.starts_with("scenarios="));
                asked.overrides.push(format!("scenarios=[{own}]"));
            }
            asked.overrides.extend(varied.iter().map(|(key, value)| format!("{key}={value}")));
            self.command_of(&asked, &experiment)
        };
        let asked: BTreeSet<Asked> = runs.map(asked).collect();
        asked.into_iter().filter_map(command).collect()
    }

    /// The command with these words, if it makes runs of this experiment.
    fn command_of(&self, asked: &Asked, experiment: &str) -> Option<String> {
        made_by(asked, experiment)?;
        let command = format!("run {}", asked.words());
        Some(match self.is_published() {
            true => format!("harness {command}"),
            false => self.registry.command(&command),
        })
    }

    /// Whether there are runs, and all of them are published copies. If none counts, those that do not count decide.
    pub fn is_published(&self) -> bool {
        let mut runs = self.experiments.values().flat_map(|experiment| &experiment.runs).peekable();
        if runs.peek().is_some() {
            return runs.all(|run| run.record.published);
        }
        let records = self.registry.records();
        !records.is_empty() && records.iter().all(|record| record.published)
    }

    /// The names of the experiments that have runs which count, in alphabetical order.
    pub fn experiments(&self) -> impl Iterator<Item = &str> {
        self.experiments.keys().map(String::as_str)
    }

    /// The runs of an experiment that count, sorted by scenario, variant, latent size, settings and seed.
    pub fn runs(&self, experiment: &str) -> &[Run] {
        self.experiments.get(experiment).map_or(&[], |experiment| &experiment.runs)
    }

    /// The runs of an experiment in a role under a reading.
    pub fn runs_under(&self, experiment: &str, reading: &str, role: &str) -> Vec<&Run> {
        let is_of = |run: &&Run| {
            let spec = &run.record.spec;
            spec.reading() == Some(reading) && spec.role() == Some(role)
        };
        self.runs(experiment).iter().filter(is_of).collect()
    }

    /// The number of samples per second of all runs that count. `None` if it differs, or if some runs use imported
    /// data.
    pub fn sample_rate_hz(&self) -> Option<f64> {
        let mut runs = self.experiments.values().flat_map(|experiment| &experiment.runs);
        let rate = |run: &Run| Some(run.record.spec.simulation.as_ref()?.sample_rate_hz);
        let first = rate(runs.next()?)?;
        runs.all(|run| rate(run) == Some(first)).then_some(first)
    }

    /// Whether a run that counts predicts further than the next sample.
    pub fn predicts_further(&self) -> bool {
        let mut runs = self.experiments.values().flat_map(|experiment| &experiment.runs);
        runs.any(|run| run.record.spec.window.horizon > 1)
    }

    /// Messages about runs that were left out, such as `left out: 3 runs of an older method`.
    pub fn notes(&self) -> &[String] {
        &self.notes
    }

    /// Checks that each of these experiments has runs that count.
    ///
    /// # Errors
    /// When one of them has none.
    pub fn check_finished(&self, experiments: &[String]) -> Result<(), AnalysisError> {
        let lacking = experiments.iter().find(|wanted| !self.experiments.contains_key(*wanted));
        lacking.map_or(Ok(()), |experiment| Err(self.nothing_of(experiment)))
    }

    /// The names of all experiments of the results folder that have finished runs, in alphabetical order.
    pub fn all_finished(&self) -> Vec<String> {
        let records = self.registry.recorded().into_iter().map(|(_, record)| record);
        let done = records.filter(|record| record.status == Status::Done);
        let names: BTreeSet<String> = done.map(|record| record.experiment).collect();
        names.into_iter().collect()
    }

    /// The specs of all finished runs of an experiment, also of those that were not selected.
    pub fn finished_specs(&self, experiment: &str) -> Vec<RunSpec> {
        let is_own = |record: &RunRecord| record.status == Status::Done && record.experiment == experiment;
        self.registry.records().into_iter().filter(is_own).map(|record| record.spec).collect()
    }

    /// The requested settings that exclude all finished runs of an experiment under a reading in a role. None if there
    /// are no such runs.
    pub fn excluding(&self, experiment: &str, reading: &str, role: &str) -> Vec<Setting> {
        let about = self.selection.settings.iter().filter(|setting| setting.is_about(experiment));
        let is_of = |spec: &RunSpec| spec.reading() == Some(reading) && spec.role() == Some(role);
        // Records are read only if settings may be the reason.
        let about: Vec<Setting> = about.cloned().collect();
        let are_there = !about.is_empty() && self.finished_specs(experiment).iter().any(is_of);
        if are_there { about } else { Vec::new() }
    }

    /// Why no run of an experiment counts.
    pub fn nothing_of(&self, experiment: &str) -> AnalysisError {
        let about = self.selection.settings.iter().filter(|setting| setting.is_about(experiment));
        let wanted: Vec<Setting> = about.cloned().collect();
        let is_own = |record: &&RunRecord| record.status == Status::Done && record.experiment == experiment;
        // Records are read only if settings may be the reason.
        let records = if wanted.is_empty() { Vec::new() } else { self.registry.records() };
        let own: Vec<Settings> = records.iter().filter(is_own).map(settings::of).collect();
        if let Some(record) = self.outdated.get(experiment) {
            return AnalysisError::Outdated {
                experiment: experiment.to_owned(),
                world: record.spec.scenario.name().to_owned(),
                version: record.world_version(),
            };
        }
        if own.is_empty() {
            let (wanted, there) = (experiment.to_owned(), self.all_finished());
            return AnalysisError::NothingFinished { wanted, there };
        }
        let keys: BTreeSet<&str> = wanted.iter().map(|setting| setting.key.as_str()).collect();
        let there = keys.into_iter().map(|key| Difference::of(key, own.iter())).collect();
        AnalysisError::NothingChosen { experiment: experiment.to_owned(), wanted, there }
    }

    /// Checks that the runs of an experiment differ only in scenario, latent size and seeds. If `by_variant`, they may
    /// also differ in the settings that their variants name.
    ///
    /// # Errors
    /// When they differ in other settings.
    pub fn check_uniform(&self, experiment: &str, by_variant: bool) -> Result<(), Mixed> {
        let Some(of) = self.experiments.get(experiment) else { return Ok(()) };
        let differences: Vec<Difference> = match by_variant {
            true => of.differences.iter().filter(|difference| !difference.in_variant).cloned().collect(),
            false => of.differences.clone(),
        };
        if differences.is_empty() {
            return Ok(());
        }
        let choice = of.most(&differences, experiment);
        Err(Mixed { experiment: experiment.to_owned(), differences, choice })
    }

    /// Checks that these runs of one experiment differ only in scenario, latent size and seeds.
    ///
    /// # Errors
    /// When they differ in other settings.
    pub fn check_alike(&self, runs: &[&Run]) -> Result<(), Mixed> {
        let all: Vec<&Settings> = runs.iter().map(|run| run.settings.as_ref()).collect();
        let differences = settings::differences(&all);
        match runs.first().map(|run| run.record.experiment.clone()) {
            Some(experiment) if !differences.is_empty() => {
                let choice = self.experiments[&experiment].most(&differences, &experiment);
                Err(Mixed { experiment, differences, choice })
            }
            _ => Ok(()),
        }
    }

    /// The settings of a run in which its experiment's runs differ, without scenario, latent size and the settings that
    /// its variant names: `training.batch_size=64, training.epochs=2`, or nothing.
    pub fn settings(&self, run: &Run) -> String {
        let Some(of) = self.experiments.get(&run.record.experiment) else { return String::new() };
        named(of.differences.iter().filter(|one| !one.in_variant && !one.of_scenario), run)
    }

    /// The settings of a run in which its experiment's runs differ, apart from those with these keys and those that
    /// follow from them. A setting follows from others if a variant names it, and if all runs with the same values of
    /// the others have the same value.
    fn settings_apart_from(&self, run: &Run, keys: &[&'static str]) -> String {
        let Some(of) = self.experiments.get(&run.record.experiment) else { return String::new() };
        let others =
            of.differences.iter().filter(|one| one.key != VARIANT && !keys.contains(&one.key.as_str()));
        let others = others.filter(|one| !one.of_scenario);
        let (varied, mut shown): (Vec<&Difference>, Vec<&Difference>) =
            others.partition(|one| one.in_variant);
        for difference in varied {
            let known: Vec<&str> =
                keys.iter().copied().chain(shown.iter().map(|difference| difference.key.as_str())).collect();
            if !of.follows(&difference.key, &known) {
                shown.push(difference);
            }
        }
        named(shown.into_iter(), run)
    }

    /// Announces queries, so that each table is read once for all of them, and only the rows that they see are kept in
    /// memory. Other queries that see only these rows are answered from memory too.
    pub fn expect<'a>(mut self, queries: impl IntoIterator<Item = &'a str>) -> Self {
        for sql in queries {
            // A wrong query is refused when it is asked.
            let Ok(query) = self.parsed(sql) else { continue };
            let read = |table: &Table| query.conditions(table.name()).is_some();
            for table in Table::ALL.into_iter().filter(read) {
                self.expected.rows.entry(table).or_default().extend(conditions(&query, table));
            }
            self.expected.queries.push(query);
        }
        self
    }

    /// Whether a query contains this name.
    pub fn contains(&self, sql: &str, name: &str) -> bool {
        self.parsed(sql).is_ok_and(|query| query.names().contains(name))
    }

    /// The parsed query. Each text is parsed once.
    fn parsed(&self, sql: &str) -> Result<Arc<Query>, QueryError> {
        let mut parsed = self.parsed.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(query) = parsed.get(sql) {
            return Ok(query.clone());
        }
        let query = Arc::new(Query::parse(sql)?);
        parsed.insert(sql.to_owned(), query.clone());
        Ok(query)
    }

    /// Answers a query over the runs of these experiments that count.
    ///
    /// # Errors
    /// Like [`query`](harness_catalog::query).
    pub fn query(&self, experiments: &[&str], sql: &str) -> Result<DataFrame, QueryError> {
        let own = || experiments.iter().copied().filter(|name| self.experiments.contains_key(*name));
        let rows =
            |of, query: &Query| own().filter_map(|name| self.table(of, name, query).transpose()).collect();
        let recorded = || own().flat_map(|name| self.runs(name)).map(Run::recorded).collect();
        self.answer(sql, rows, recorded)
    }

    /// Answers a query. `rows` returns the parts of a table that each run writes. `recorded` returns the runs of the
    /// other tables.
    fn answer(
        &self,
        sql: &str,
        rows: impl Fn(Table, &Query) -> PolarsResult<Vec<LazyFrame>> + Sync,
        recorded: impl Fn() -> Vec<(PathBuf, RunRecord)> + Sync,
    ) -> Result<DataFrame, QueryError> {
        answer(&*self.parsed(sql)?, &|of, query| match of {
            Table::Epochs
            | Table::Metrics
            | Table::Sums
            | Table::Predictions
            | Table::Forces
            | Table::Frames => {
                let found = one_after_the_other(rows(of, query)?)?;
                found.map_or_else(|| table(&self.registry, of, &[], query), Ok)
            }
            Table::Runs | Table::Episodes | Table::AllMetrics | Table::AllPredictions => {
                table(&self.registry, of, &recorded(), query)
            }
        })
    }

    /// Answers a query over only these runs. Their tables are read for this query alone.
    ///
    /// # Errors
    /// Like [`query`](harness_catalog::query).
    pub fn query_runs<'a>(
        &self,
        runs: impl IntoIterator<Item = &'a Run>,
        sql: &str,
    ) -> Result<DataFrame, QueryError> {
        let recorded: Vec<_> = runs.into_iter().map(Run::recorded).collect();
        answer(&*self.parsed(sql)?, &|of, query| table(&self.registry, of, &recorded, query))
    }

    /// A table of an experiment's runs; `None` if none of them has it. It is taken from memory if the expected queries
    /// see all rows that `query` sees.
    fn table(&self, table: Table, experiment: &str, query: &Query) -> PolarsResult<Option<LazyFrame>> {
        if self.expected.sees(query, table) {
            let seen = self.seen(table, experiment, experiment)?.only(conditions(query, table));
            if seen.schema.is_empty() {
                return Ok(None);
            }
            seen.read(query, &[])?;
            let schema = seen.schema.clone();
            return lazily(seen, schema).map(Some);
        }
        let rows = self.run_table(table, experiment)?;
        let schema = rows.schema()?;
        if schema.is_empty() {
            return Ok(None);
        }
        lazily(rows.only(conditions(query, table)), schema).map(Some)
    }

    /// A table of an experiment's runs. Forces describe a dataset and are the same in all of its runs, so they are read
    /// from one run of each dataset, as in published results.
    fn run_table(&self, table: Table, experiment: &str) -> PolarsResult<RunTable> {
        let mut runs: Vec<&RunRecord> = self.runs(experiment).iter().map(|run| &run.record).collect();
        if table == Table::Forces {
            let mut known = BTreeSet::new();
            runs.retain(|run| run.has(table) && known.insert(forces_of(run)));
        }
        Ok(RunTable::new(&self.registry, table, experiment, runs.into_iter())?)
    }

    /// The rows that the expected queries see of a table of an experiment's runs. The queries name the experiment
    /// `name`.
    fn seen(&self, table: Table, experiment: &str, name: &str) -> PolarsResult<Seen> {
        let mut tables = self.tables.lock().unwrap_or_else(PoisonError::into_inner);
        let is_renamed = name != experiment;
        let key = (table, experiment.to_owned(), is_renamed);
        if let Some(seen) = tables.get(&key) {
            return Ok(seen.clone());
        }
        let rows = self.run_table(table, experiment)?;
        let schema = rows.schema()?;
        let mut conditions = self.expected.rows.get(&table).cloned().unwrap_or_default();
        // The rows have the experiment's own name.
        if is_renamed {
            let without_name = |mut condition: Condition| {
                condition.remove("experiment");
                condition
            };
            conditions = conditions.into_iter().map(without_name).collect();
        }
        let seen = Seen::new(table, rows.only(conditions), schema, &self.expected);
        Ok(tables.entry(key).or_insert(seen).clone())
    }
}

impl Experiment {
    /// Finds the settings in which the runs differ, and sorts the runs.
    fn arrange(&mut self) {
        let all: Vec<&Settings> = self.runs.iter().map(|run| run.settings.as_ref()).collect();
        self.differences = settings::differences(&all);
        let differences = &self.differences;
        self.runs.sort_by_cached_key(|run| {
            let spec = &run.record.spec;
            let settings = named(differences.iter(), run);
            (
                spec.scenario.clone(),
                spec.variant.clone(),
                spec.latent(),
                settings,
                spec.seed,
                run.record.run.clone(),
            )
        });
    }

    /// Whether all runs with the same values of some settings have the same value of another one.
    fn follows(&self, key: &str, from: &[&str]) -> bool {
        let mut values: BTreeMap<Vec<&str>, &str> = BTreeMap::new();
        let concerned = self.runs.iter().filter(|run| settings::concerns(&run.settings, key));
        concerned.map(|run| &run.settings).all(|run| {
            let own = settings::value(run, key);
            let others = from.iter().map(|key| settings::value(run, key)).collect();
            *values.entry(others).or_insert(own) == own
        })
    }

    /// Values of the differing settings that select the most runs. If several values select equally many, those of the
    /// run that was started last are chosen.
    fn most(&self, differences: &[Difference], experiment: &str) -> Vec<Setting> {
        let of_specs =
            || differences.iter().map(|difference| difference.key.as_str()).filter(|key| *key != DATASET);
        let values = |run: &Run| -> Vec<(String, String)> {
            of_specs().map(|key| (key.to_owned(), settings::value(&run.settings, key).to_owned())).collect()
        };
        let mut chosen = commonest(self.runs.iter().map(|run| (values(run), run)));
        if differences.iter().any(|difference| difference.key == DATASET) {
            // Each scenario has its own dataset.
            let mut datasets: BTreeMap<&Origin, Vec<(String, &Run)>> = BTreeMap::new();
            for run in self.runs.iter().filter(|run| values(run) == chosen) {
                let dataset = (run.record.dataset.clone(), run);
                datasets.entry(&run.record.spec.scenario).or_default().push(dataset);
            }
            chosen.extend(datasets.into_values().map(|runs| (DATASET.to_owned(), commonest(runs))));
        }
        let setting = |(key, value)| Setting { experiment: Some(experiment.to_owned()), key, value };
        chosen.into_iter().map(setting).collect()
    }
}

/// The experiment whose runs a command makes, if it is the one of this name.
fn made_by(asked: &Asked, experiment: &str) -> Option<harness_spec::Experiment> {
    let made = harness_spec::load(&asked.spec, &asked.overrides, asked.quick).ok()?;
    (made.name == experiment).then_some(made)
}

/// The key that most runs have. If several keys are equally common, that of the run that was started last.
fn commonest<'a, K: Ord + Default>(runs: impl IntoIterator<Item = (K, &'a Run)>) -> K {
    let mut groups: BTreeMap<K, (usize, &str)> = BTreeMap::new();
    for (key, run) in runs {
        let (count, last) = groups.entry(key).or_default();
        (*count, *last) = (*count + 1, run.record.started.as_str().max(last));
    }
    groups.into_iter().max_by_key(|(_, standing)| *standing).map(|(key, _)| key).unwrap_or_default()
}

/// The run's values of the differing settings, as `key=value, key=value`.
fn named<'a>(differences: impl Iterator<Item = &'a Difference>, run: &Run) -> String {
    let value = |difference: &Difference| {
        format!("{}={}", difference.key, settings::value(&run.settings, &difference.key))
    };
    // An external model has no settings of a network.
    let is_own = |difference: &&Difference| {
        run.record.spec.trained().is_some() || settings::concerns(&run.settings, &difference.key)
    };
    differences.filter(is_own).map(value).collect::<Vec<_>>().join(", ")
}

/// Checks that some run has each of these settings. A run is an experiment's name and settings, and `kind` says what
/// the runs are.
fn check_settings(wanted: &[Setting], runs: &[(&str, &Settings)], kind: &str) -> Result<(), AnalysisError> {
    for setting in wanted.iter().filter(|_| !runs.is_empty()) {
        let about = || runs.iter().filter(|(experiment, _)| setting.is_about(experiment)).map(|run| run.1);
        if let Some(wanted) = setting.experiment.as_ref().filter(|_| about().next().is_none()) {
            let there: BTreeSet<String> =
                runs.iter().map(|(experiment, _)| (*experiment).to_owned()).collect();
            let there = there.into_iter().collect();
            return Err(AnalysisError::NothingFinished { wanted: wanted.clone(), there });
        }
        let keys: BTreeSet<&str> = about().flat_map(settings::keys).collect();
        if !keys.contains(setting.key.as_str()) {
            let wanted = &setting.key;
            let instead = match nearest(wanted, &keys.into_iter().collect::<Vec<_>>()) {
                Some(key) => format!("did you mean '{key}'?"),
                None => "use a key of the spec, such as training.batch_size".to_owned(),
            };
            return Err(AnalysisError::Unanswerable(format!("no run has a setting '{wanted}'; {instead}")));
        }
        if !about().any(|run| setting.is_met_by(run)) {
            let there = Difference::of(&setting.key, about());
            return Err(AnalysisError::Unanswerable(format!(
                "no {kind} has {setting}; {kind}s have {there}"
            )));
        }
    }
    Ok(())
}

/// Returns for each planned run of an experiment whether it has the requested settings.
///
/// # Errors
/// When no run has one of the settings, or its value.
pub fn planned(
    experiment: &str,
    runs: &[(&RunSpec, &Layout)],
    wanted: &[Setting],
) -> Result<Vec<bool>, AnalysisError> {
    let runs: Vec<Settings> = runs.iter().map(|(spec, layout)| settings::of_spec(spec, layout)).collect();
    let named: Vec<_> = runs.iter().map(|run| (experiment, run)).collect();
    check_settings(wanted, &named, "planned run")?;
    Ok(runs.iter().map(|run| settings::meets(wanted, experiment, run)).collect())
}

/// The runs that the newest revision made, without repetitions, and messages about the runs that are left out.
fn newest(runs: Vec<Run>) -> (Vec<Run>, Vec<String>) {
    let newest = runs.iter().map(|run| run.record.revision()).max().flatten();
    let all = runs.len();
    // Runs with the same spec, seed and dataset are the same run, even if an older version gave it another name.
    let mut counted: BTreeMap<String, Run> = BTreeMap::new();
    let of_newest = runs.into_iter().filter(|run| run.record.revision() == newest);
    let mut older = all;
    let mut twice = 0;
    for run in of_newest {
        older -= 1;
        let key = format!("{} {} {}", run.record.experiment, run.record.spec.hash(), run.record.dataset);
        match counted.get(&key) {
            None => drop(counted.insert(key, run)),
            Some(other) => {
                twice += 1;
                if (&run.record.started, &run.record.run) > (&other.record.started, &other.record.run) {
                    counted.insert(key, run);
                }
            }
        }
    }
    let note = |count: usize, what: &str| (count > 0).then(|| format!("left out: {count} {what}"));
    let notes = [note(older, "runs of an older method"), note(twice, "runs that were done again since")];
    (counted.into_values().collect(), notes.into_iter().flatten().collect())
}
