//! Tests statements, such as the paper's, on the tables of runs.
//!
//! A claim is a statement with a query and a condition on the query's result.

mod contacts;
mod counts;
mod file;
mod metric;
mod plan;
mod readings;
mod table;

pub use contacts::{Contacts, contacts};
pub use counts::Counts;
pub use file::{ClaimsFile, load};
pub use plan::{More, Plan, Step, plan};
pub use readings::{Matrix, OWN, Readings, Row as MatrixRow, described};
pub use table::table;

use harness_analysis::{
    Analysis, AnalysisError, Estimate, Interval, LEVEL, Mixed, Run, Selection, Setting, Subset, holm,
    replicates, unpaired_replicates,
};
use harness_catalog::{QueryError, rows};
use harness_registry::{Recorded, Registry};
use harness_shared::meant;
use harness_spec::{Origin, QUICK, Scenario, SpecError};
use metric::ClaimMetric;
use polars::prelude::DataFrame;
use serde::de::Error;
use serde::{Deserialize, Deserializer};
use serde_yaml::{Location, Spanned};
use std::collections::{BTreeMap, BTreeSet};
use std::fmt;

/// A statement, and how to test it.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Claim {
    id: Spanned<String>,
    /// The statement, or a summary of it.
    #[serde(alias = "paper")]
    pub statement: String,
    /// The section and figure of a paper that makes the statement. Empty without one.
    #[serde(default)]
    pub section: String,
    /// A description of the query's value, with its unit.
    pub measured: String,
    /// The scenarios that are judged one by one: names of worlds, the built-in ones or others. Empty if the claim has
    /// one judgment over all of them.
    #[serde(default)]
    pub scenarios: Vec<Scenario>,
    /// The two scenarios whose difference is judged: the value in the first minus that in the second. Their datasets
    /// have different motions, so the difference is not paired.
    #[serde(default, deserialize_with = "two_scenarios")]
    pub difference: Option<[Scenario; 2]>,
    /// The experiments whose tables the queries read.
    pub experiments: Vec<String>,
    /// The latent sizes that replace `{experiment}` in the queries. Their number replaces `{experiment.runs}`.
    #[serde(default)]
    pub latent: Sizes,
    /// The metric by which the claim compares predictions. It is inserted in the claim and in its requirement.
    metric: Option<Spanned<ClaimMetric>>,
    /// A condition without which the claim can't be tested. The claim is not testable if it does not hold or is
    /// undecided.
    pub requires: Option<Requirement>,
    query: Spanned<String>,
    /// The condition that the query's value satisfies if the claim holds.
    pub condition: Condition,
    /// The name of the file.
    #[serde(skip)]
    file: String,
}

/// Latent sizes by experiment.
pub type Sizes = BTreeMap<String, BTreeSet<usize>>;

/// A condition without which a claim can't be tested, such as that the compared networks have learned something. It is
/// measured for the claim's scenarios, on the tables of its experiments.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Requirement {
    /// A description of the query's value, with its unit.
    pub measured: String,
    query: Spanned<String>,
    /// The condition that the query's value must satisfy.
    pub condition: Condition,
}

/// Reads the scenarios of a difference.
fn two_scenarios<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<[Scenario; 2]>, D::Error> {
    match Vec::<Scenario>::deserialize(deserializer)?.as_slice() {
        [a, b] if a != b => Ok(Some([*a, *b])),
        _ => Err(D::Error::custom(
            "a difference is between two scenarios; write [cluttered, empty], for example",
        )),
    }
}

impl Claim {
    /// The claim's id, such as `vision_improves_force`. It is unique in its file.
    pub fn id(&self) -> &str {
        &self.id.value
    }

    /// The names of the experiments in tables. Those of quick runs end in [`QUICK`].
    pub fn experiments(&self, quick: bool) -> Vec<String> {
        let ending = if quick { QUICK } else { "" };
        self.experiments.iter().map(|name| format!("{name}{ending}")).collect()
    }

    /// Says which metrics the runs of the claim have, if none of them has the claim's metric.
    ///
    /// # Errors
    /// When a table is damaged.
    pub fn absent_metric(&self, analysis: &Analysis, quick: bool) -> Result<Option<String>, ClaimsError> {
        let Some(metric) = &self.metric else { return Ok(None) };
        let failed = |error: QueryError| self.fault(metric.referenced, error.to_string());
        let experiments = self.experiments(quick);
        let runs = experiments.iter().flat_map(|name| analysis.runs(name));
        let mut answer = analysis.query_runs(runs, METRICS).map_err(failed)?;
        let there: Vec<Named> = rows(&mut answer).map_err(failed)?;
        let there: Vec<&str> = there.iter().map(|metric| metric.name.as_str()).collect();
        let wanted = metric.value.name();
        if there.is_empty() || there.contains(&wanted) {
            return Ok(None);
        }
        let problem = format!("no run has the metric '{wanted}'; the runs have {}", there.join(", "));
        Ok(Some(self.fault(metric.referenced, problem).to_string()))
    }

    /// The claim's query, completed, over the runs of the experiments or, if `quick`, over their quick runs.
    pub fn sql(&self, quick: bool) -> String {
        self.complete(&self.query.value, &self.latent, quick)
    }

    /// The requirement's query, completed, or `None` without a requirement.
    pub fn required_sql(&self, quick: bool) -> Option<String> {
        let requirement = self.requires.as_ref()?;
        Some(self.complete(&requirement.query.value, &self.latent, quick))
    }

    /// The error about a part of the claim that starts at `place` in its file.
    fn fault(&self, place: Location, problem: String) -> ClaimsError {
        let (file, id) = (&self.file, self.id());
        ClaimsError::Invalid(format!("{file}:{}:{}: claim '{id}': {problem}", place.line(), place.column()))
    }

    /// The scenarios that are judged one by one, or `None` alone if there is one judgment.
    fn judged(&self) -> Vec<Option<Scenario>> {
        match self.scenarios.as_slice() {
            [] => vec![None],
            scenarios => scenarios.iter().copied().map(Some).collect(),
        }
    }

    /// The scenarios of the query's values: those that are judged one by one, or those of the difference.
    fn measured_in(&self) -> Vec<Option<Scenario>> {
        self.difference.map_or_else(|| self.judged(), |both| both.map(Some).to_vec())
    }

    /// The queries of the claim and of its requirement, as they are in the file.
    fn queries(&self) -> impl Iterator<Item = &Spanned<String>> {
        std::iter::once(&self.query).chain(self.requires.as_ref().map(|requirement| &requirement.query))
    }

    /// Puts those definitions before the claim's queries whose names they contain.
    fn insert(&mut self, definitions: &BTreeMap<String, Spanned<String>>) {
        let required = self.requires.as_mut().map(|requirement| &mut requirement.query.value);
        for query in std::iter::once(&mut self.query.value).chain(required) {
            *query = file::with_definitions(query, definitions);
        }
    }

    /// Inserts the claim's metric in its texts and queries.
    fn insert_metric(&mut self) {
        let Some(metric) = &self.metric else { return };
        let own = [&mut self.measured, &mut self.query.value];
        let required = self.requires.as_mut();
        let required = required.map(|requirement| [&mut requirement.measured, &mut requirement.query.value]);
        for text in own.into_iter().chain(required.into_iter().flatten()) {
            *text = metric.value.complete(text);
        }
    }

    /// Inserts these latent sizes in a query, and, if `quick`, the names of the quick runs' experiments.
    fn complete(&self, query: &str, sizes: &Sizes, quick: bool) -> String {
        let mut sql = query.to_owned();
        for (name, sizes) in sizes {
            let listed: Vec<String> = sizes.iter().map(usize::to_string).collect();
            sql = sql.replace(&format!("{{{name}}}"), &format!("({})", listed.join(", ")));
            sql = sql.replace(&format!("{{{name}.runs}}"), &sizes.len().to_string());
        }
        for name in self.experiments.iter().filter(|_| quick) {
            sql = sql.replace(&format!("'{name}'"), &format!("'{name}{QUICK}'"));
        }
        sql
    }
}

/// A condition on a measured value. It is written as `above NUMBER`, `below NUMBER` or `below margin NUMBER`.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(try_from = "String")]
pub enum Condition {
    /// The value is greater than the bound.
    Above(f64),
    /// The value is less than the bound.
    Below(f64),
    /// The value, an advantage, is less than the margin: the least advantage that matters. This is the condition of
    /// statements that something is no better, or has no substantial advantage. If only advantages below zero satisfied
    /// it, two equal networks could never show that neither is better.
    Margin(f64),
}

impl Condition {
    /// The bound, in the unit of the value.
    pub fn bound(self) -> f64 {
        let (Self::Above(bound) | Self::Below(bound) | Self::Margin(bound)) = self;
        bound
    }

    /// Whether a value satisfies the condition.
    pub fn satisfied_by(self, value: f64) -> bool {
        match self {
            Self::Above(bound) => value > bound,
            Self::Below(bound) | Self::Margin(bound) => value < bound,
        }
    }

    /// The verdict on a mean with this interval, of values for each seed, episode or dataset.
    fn judge(self, interval: Interval, each: Each) -> Verdict {
        match interval.bounds.map(|(low, high)| (self.satisfied_by(low), self.satisfied_by(high))) {
            None => Verdict::OneValue { each, satisfied: self.satisfied_by(interval.mean) },
            Some((true, true)) => Verdict::Holds,
            Some((false, false)) => Verdict::DoesNotHold,
            Some(_) => Verdict::Undecided,
        }
    }
}

impl fmt::Display for Condition {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Self::Above(bound) => write!(f, "above {bound}"),
            Self::Below(bound) => write!(f, "below {bound}"),
            Self::Margin(bound) => write!(f, "below margin {bound}"),
        }
    }
}

impl TryFrom<String> for Condition {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        let refused = || {
            format!(
                "'{text}' is not a condition; write 'above NUMBER', 'below NUMBER' or 'below margin NUMBER' with a \
                 margin above 0"
            )
        };
        let (words, bound) = text.trim().rsplit_once(' ').ok_or_else(refused)?;
        let bound: f64 = bound.parse().map_err(|_| refused())?;
        match words.split_whitespace().collect::<Vec<_>>().as_slice() {
            _ if !bound.is_finite() => Err(refused()),
            ["above"] => Ok(Self::Above(bound)),
            ["below"] => Ok(Self::Below(bound)),
            ["below", "margin"] if bound > 0.0 => Ok(Self::Margin(bound)),
            _ => Err(refused()),
        }
    }
}

/// An error in reading or judging claims.
#[derive(Debug, thiserror::Error)]
pub enum ClaimsError {
    /// The file of claims can't be read, or is invalid.
    #[error(transparent)]
    File(#[from] SpecError),
    /// No claim has a wanted id, a claim's query failed, or its answer does not have the required columns and rows. The
    /// text is the message.
    #[error("{0}")]
    Invalid(String),
}

/// Values by the seed of the dataset, and by seed or episode. For a value of the whole dataset, the second number is 0.
pub type Values = BTreeMap<(u64, i64), f64>;

/// The values that a claim's query returned for one scenario, or for both together. There are none if runs are missing.
#[derive(Debug, Clone, PartialEq)]
pub struct Measured {
    /// Whether there is a value for each seed, for each episode, or for each dataset.
    pub each: Each,
    /// The values.
    pub values: Values,
    /// The values that are subtracted if the claim is about the difference between two scenarios.
    pub minus: Option<Values>,
}

impl Measured {
    /// The mean over datasets, and over the seeds or episodes of each, or the difference between two such means. If
    /// there are several datasets, it is computed from their means. `None` without values.
    pub fn estimate(&self) -> Option<Estimate> {
        let of = |values: &Values| {
            values.iter().map(|((dataset, _), value)| (*dataset, *value)).collect::<Vec<_>>()
        };
        let Some(minus) = &self.minus else { return Estimate::of(&replicates(of(&self.values))) };
        let [values, minus] = unpaired_replicates([of(&self.values), of(minus)]);
        Estimate::difference(&values, &minus)
    }

    /// The estimate with its confidence interval. `None` without values.
    pub fn interval(&self) -> Option<Interval> {
        Some(self.estimate()?.interval(LEVEL))
    }

    /// The number of values.
    pub fn count(&self) -> usize {
        self.groups().map(BTreeMap::len).sum()
    }

    /// The number of datasets that have values. For a difference between scenarios, it is the smaller of both numbers.
    pub fn datasets(&self) -> usize {
        self.groups().map(|values| datasets_of(values).len()).min().unwrap_or_default()
    }

    /// The values, and those that are subtracted if there are any.
    pub fn groups(&self) -> impl Iterator<Item = &Values> {
        std::iter::once(&self.values).chain(&self.minus)
    }

    /// What the value belongs to if there is only one in a group.
    fn single(&self) -> Each {
        let several = self.groups().any(|values| datasets_of(values).len() > 1);
        if several { Each::Dataset } else { self.each }
    }
}

/// The seeds of the datasets of values.
fn datasets_of(values: &Values) -> BTreeSet<u64> {
    values.keys().map(|(dataset, _)| *dataset).collect()
}

/// What a measured value belongs to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Each {
    /// A seed of the runs.
    Seed,
    /// An episode of the dataset, for claims about the dataset alone.
    Episode,
    /// A dataset, for claims about the dataset alone whose value can't be computed by episode.
    Dataset,
}

impl Each {
    /// The name. It is also the column in a query's answer, which has no such column for datasets.
    pub fn name(self) -> &'static str {
        match self {
            Self::Seed => "seed",
            Self::Episode => "episode",
            Self::Dataset => "dataset",
        }
    }
}

/// The verdict on a claim.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Verdict {
    /// The whole interval satisfies the condition.
    Holds,
    /// The whole interval violates the condition.
    DoesNotHold,
    /// A part of the interval satisfies the condition, and a part violates it.
    Undecided,
    /// There is only one value, and so no interval.
    OneValue {
        /// What the value belongs to.
        each: Each,
        /// Whether the value satisfies the condition.
        satisfied: bool,
    },
    /// The claim's requirement does not hold or is undecided. With one seed, the seed's value violates it.
    NotTestable,
    /// The runs differ in settings that the query does not distinguish, so nothing is measured.
    Mixed,
    /// There are no values.
    NoData,
}

impl fmt::Display for Verdict {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.pad(match self {
            Self::Holds => "holds",
            Self::DoesNotHold => "does not hold",
            Self::Undecided => "undecided",
            Self::OneValue { each, satisfied } => {
                let word = if *satisfied { "agrees" } else { "disagrees" };
                return f.pad(&format!("undecided: 1 {}, {word}", each.name()));
            }
            Self::NotTestable => "not testable",
            Self::Mixed => "undecided: settings differ",
            Self::NoData => "no data",
        })
    }
}

/// A claim and its measured values, for one scenario or for both together.
#[derive(Debug, Clone)]
pub struct Judgment<'a> {
    /// The claim.
    pub claim: &'a Claim,
    /// The scenario, or `None` if the claim is about both together.
    pub scenario: Option<Scenario>,
    /// The values of the claim's query.
    pub measured: Measured,
    /// The values of the requirement's query; `None` if the claim has no requirement.
    pub required: Option<Measured>,
    /// The experiments whose runs differ in settings. If there are any, nothing is measured.
    pub mixed: Vec<Mixed>,
}

impl Judgment<'_> {
    /// The mean over datasets, and over the seeds or episodes of each, with its confidence interval. `None` without
    /// values.
    pub fn interval(&self) -> Option<Interval> {
        self.measured.interval()
    }

    /// The verdict on the claim.
    pub fn verdict(&self) -> Verdict {
        match self.interval() {
            None if self.mixed.is_empty() => Verdict::NoData,
            None => Verdict::Mixed,
            Some(_) if self.unmet().is_some() => Verdict::NotTestable,
            Some(interval) => self.claim.condition.judge(interval, self.measured.single()),
        }
    }

    /// Half of the interval's width, if the claim is undecided or not testable. An undecided claim whose value is farther
    /// from the condition's bound would have been decided. `None` without an interval.
    pub fn resolution(&self) -> Option<f64> {
        let is_open = matches!(self.verdict(), Verdict::Undecided | Verdict::NotTestable);
        let (low, high) = self.interval()?.bounds?;
        is_open.then_some((high - low) / 2.0)
    }

    /// The two-sided p-value of a t-test against the condition's bound. `None` unless the claim holds, does not hold,
    /// or is undecided, and if all values are equal.
    pub fn p_value(&self) -> Option<f64> {
        let is_tested = matches!(self.verdict(), Verdict::Holds | Verdict::DoesNotHold | Verdict::Undecided);
        self.measured.estimate()?.p_value(self.claim.condition.bound()).filter(|_| is_tested)
    }

    /// The values with their scenario, which is `None` if the claim is about both together. A difference between two
    /// scenarios has the values of each.
    pub fn groups(&self) -> Vec<(Option<Scenario>, &Values)> {
        let scenarios =
            self.claim.difference.map_or_else(|| vec![self.scenario], |both| both.map(Some).to_vec());
        scenarios.into_iter().zip(self.measured.groups()).collect()
    }

    /// Describes the claim's requirement if it does not hold or is undecided: what was measured, its value and the
    /// condition.
    pub fn unmet(&self) -> Option<String> {
        let Requirement { measured, condition, .. } = self.claim.requires.as_ref()?;
        let required = self.required.as_ref();
        let interval = required.and_then(Measured::interval);
        match required.zip(interval).map(|(required, interval)| condition.judge(interval, required.each)) {
            Some(Verdict::Holds | Verdict::OneValue { satisfied: true, .. }) => None,
            _ => {
                let value = interval.map_or("no value".to_owned(), |interval| interval.to_string());
                Some(format!("{measured}: {value}, not {condition}"))
            }
        }
    }

    /// Whether the verdict is not one that the correction of p-values for their number ([`corrected`]) makes undecided.
    pub fn stands(&self, corrected: Option<f64>) -> bool {
        let is_decided = matches!(self.verdict(), Verdict::Holds | Verdict::DoesNotHold);
        !is_decided || corrected.is_none_or(|p| p < 1.0 - LEVEL)
    }
}

/// The p-values of judgments, corrected for the number of tests by the method of Holm. `None` where nothing is tested.
pub fn corrected<'a, 'b: 'a>(judgments: impl IntoIterator<Item = &'a Judgment<'b>>) -> Vec<Option<f64>> {
    let p_values: Vec<Option<f64>> = judgments.into_iter().map(Judgment::p_value).collect();
    let mut corrected = holm(&p_values.iter().copied().flatten().collect::<Vec<_>>()).into_iter();
    p_values.into_iter().map(|p| p.and_then(|_| corrected.next())).collect()
}

/// The claims with the ids `wanted`, in the order of the file. If `wanted` is empty, all claims.
///
/// # Errors
/// When no claim has one of the ids.
pub fn choose<'a>(claims: &'a [Claim], wanted: &[String]) -> Result<Vec<&'a Claim>, ClaimsError> {
    for wanted in wanted {
        if !claims.iter().any(|claim| claim.id() == wanted) {
            let ids: Vec<&str> = claims.iter().map(Claim::id).collect();
            let (meant, ids) = (meant(wanted, &ids), ids.join(", "));
            return Err(ClaimsError::Invalid(format!(
                "no claim is called '{wanted}'{meant}the claims are {ids}"
            )));
        }
    }
    Ok(claims.iter().filter(|claim| wanted.is_empty() || wanted.iter().any(|w| w == claim.id())).collect())
}

/// The runs that claims are about. The claims' queries are announced, so that each table is read once.
///
/// # Errors
/// When no run has one of the requested settings, or its value.
pub fn runs(
    registry: &Registry,
    claims: &[&Claim],
    settings: &[Setting],
    quick: bool,
) -> Result<Analysis, AnalysisError> {
    runs_of(registry, registry.recorded(), claims, settings, quick)
}

/// Like [`runs`], with the runs of a results folder that were read before.
///
/// # Errors
/// Like [`runs`].
pub fn runs_of(
    registry: &Registry,
    recorded: Vec<Recorded>,
    claims: &[&Claim],
    settings: &[Setting],
    quick: bool,
) -> Result<Analysis, AnalysisError> {
    let analysis = Analysis::of(registry, recorded, &selection(claims, settings, quick))?;
    Ok(expect(analysis, claims, quick))
}

/// The selection of runs for these claims, to which a caller may add experiments.
pub fn selection(claims: &[&Claim], settings: &[Setting], quick: bool) -> Selection {
    let experiments = claims.iter().flat_map(|claim| claim.experiments(quick)).collect();
    // A query that does not name the column `variant` is about networks. Their means must not contain other models.
    let is_of_networks = |claim: &&&Claim| !claim.queries().any(|query| query.value.contains("variant"));
    let trained = claims.iter().filter(is_of_networks).flat_map(|claim| claim.experiments(quick)).collect();
    // The paper's statements are about the simulated scenarios.
    Selection { experiments, settings: settings.to_vec(), simulated: true, trained }
}

/// Announces the claims' queries to `analysis`, so that each table is read once.
pub fn expect(analysis: Analysis, claims: &[&Claim], quick: bool) -> Analysis {
    let of = |claim: &&Claim| {
        claim.queries().map(|query| claim.complete(&query.value, &claim.latent, quick)).collect::<Vec<_>>()
    };
    let queries: Vec<String> = claims.iter().flat_map(of).collect();
    analysis.expect(queries.iter().map(String::as_str))
}

/// Judges a claim by the runs of its experiments. Returns one judgment for each of its scenarios, or a single one.
///
/// # Errors
/// When a query is invalid, or its answer does not have the columns and rows of a claim. Queries are checked even if
/// there are no runs.
pub fn judge<'a>(
    analysis: &Analysis,
    claim: &'a Claim,
    quick: bool,
) -> Result<Vec<Judgment<'a>>, ClaimsError> {
    // A query that names the column `variant` distinguishes the settings that variants name.
    let completed = |query: &Spanned<String>| claim.complete(&query.value, &claim.latent, quick);
    let by_variant = claim.queries().all(|query| analysis.contains(&completed(query), "variant"));
    let experiments = claim.experiments(quick).into_iter().map(|name| {
        let checked = analysis.check_uniform(&name, by_variant);
        let runs = analysis.runs(&name).iter().collect();
        (name, runs, checked)
    });
    Evidence::of(analysis, experiments.collect()).judge(claim, &claim.latent, quick)
}

/// The runs by which a claim is judged.
struct Evidence<'a> {
    analysis: &'a Analysis,
    /// The experiments' names in queries, and their runs.
    runs: Vec<(String, Vec<&'a Run>)>,
    mixed: Vec<Mixed>,
}

impl<'a> Evidence<'a> {
    /// The runs of experiments, by the experiments' names in queries, with the results of checking that the runs do not
    /// differ in settings. If a check failed, no runs are used.
    fn of(analysis: &'a Analysis, experiments: Vec<(String, Vec<&'a Run>, Result<(), Mixed>)>) -> Self {
        let mixed: Vec<Mixed> =
            experiments.iter().filter_map(|(.., checked)| checked.clone().err()).collect();
        let usable = |runs| if mixed.is_empty() { runs } else { Vec::new() };
        let runs = experiments.into_iter().map(|(name, runs, _)| (name, usable(runs))).collect();
        Self { analysis, runs, mixed }
    }

    fn judge<'c>(
        &self,
        claim: &'c Claim,
        sizes: &Sizes,
        quick: bool,
    ) -> Result<Vec<Judgment<'c>>, ClaimsError> {
        let datasets = self.by_dataset();
        let measure = |query: &Spanned<String>, scenarios: &[Option<Scenario>]| {
            let sql = claim.complete(&query.value, sizes, quick);
            measure(&datasets, &sql, scenarios).map_err(|problem| claim.fault(query.defined, problem))
        };
        let judged = claim.judged();
        let mut measured = measure(&claim.query, &claim.measured_in())?;
        if claim.difference.is_some() {
            let minus = measured.pop().map(|subtracted| subtracted.values);
            measured.iter_mut().for_each(|measured| measured.minus.clone_from(&minus));
        }
        let required =
            claim.requires.as_ref().map(|requires| measure(&requires.query, &judged)).transpose()?;
        let mut required = required.into_iter().flatten();
        let judgment = |(scenario, measured)| Judgment {
            claim,
            scenario,
            measured,
            required: required.next(),
            mixed: self.mixed.clone(),
        };
        Ok(judged.into_iter().zip(measured).map(judgment).collect())
    }

    /// The runs of each dataset, with the dataset's seed. Queries are answered for each dataset separately, because
    /// claims compare runs on the same dataset.
    fn by_dataset(&self) -> Vec<(u64, Subset<'a>)> {
        let seed_of = |run: &Run| run.record.spec.dataset_seed();
        let mut seeds: BTreeSet<u64> =
            self.runs.iter().flat_map(|(_, runs)| runs).map(|run| seed_of(run)).collect();
        if seeds.is_empty() {
            seeds.insert(0);
        }
        let of_dataset = |seed: u64| {
            let own = |runs: &Vec<&'a Run>| runs.iter().copied().filter(|run| seed_of(run) == seed).collect();
            let runs = self.runs.iter().map(|(name, runs)| (name.clone(), own(runs))).collect();
            (seed, self.analysis.subset(runs))
        };
        seeds.into_iter().map(of_dataset).collect()
    }
}

/// The names of all metrics.
const METRICS: &str = "select distinct metric as name from metrics order by name";

/// A name in a query's answer.
#[derive(Deserialize)]
struct Named {
    name: String,
}

/// A row of a query's answer.
#[derive(Deserialize)]
struct Row {
    scenario: Option<Origin>,
    #[serde(alias = "episode", default)]
    seed: i64,
    value: Option<f64>,
}

/// The values of a query on all datasets, for each of the scenarios.
fn measure(
    datasets: &[(u64, Subset)],
    sql: &str,
    scenarios: &[Option<Scenario>],
) -> Result<Vec<Measured>, String> {
    let empty = || Measured { each: Each::Seed, values: Values::new(), minus: None };
    let mut found: Vec<Measured> = scenarios.iter().map(|_| empty()).collect();
    for (dataset, runs) in datasets {
        let mut answer = runs.query(sql).map_err(|error| error.to_string())?;
        let each = check_columns(&answer, scenarios != [None])?;
        let rows: Vec<Row> = rows(&mut answer).map_err(|error| error.to_string())?;
        for (scenario, measured) in scenarios.iter().zip(&mut found) {
            measured.each = each;
            for row in rows.iter().filter(|row| row.scenario == scenario.map(Origin::from)) {
                // An undefined value counts as not measured.
                let key = (*dataset, row.seed);
                if row.value.is_some_and(|value| measured.values.insert(key, value).is_some()) {
                    return Err(repeated(each, row.seed));
                }
            }
        }
    }
    Ok(found)
}

/// The message about a query that gives several values where one is allowed.
fn repeated(each: Each, seed: i64) -> String {
    let name = each.name();
    match each {
        Each::Dataset => "it gives several values; group by scenario".to_owned(),
        _ => format!("it gives {name} {seed} several values; group by scenario and {name}"),
    }
}

/// Checks the columns of a query's answer. Returns whether a row is a seed, an episode or a dataset.
fn check_columns(answer: &DataFrame, by_scenario: bool) -> Result<Each, String> {
    let mut found: Vec<&str> = answer.get_column_names().into_iter().map(|name| name.as_str()).collect();
    let scenario = by_scenario.then_some("scenario");
    let each = if found.contains(&"episode") {
        Each::Episode
    } else if found.iter().all(|name| Some(*name) == scenario || *name == "value") {
        Each::Dataset
    } else {
        Each::Seed
    };
    let number = (each != Each::Dataset).then(|| each.name());
    let mut expected: Vec<&str> = scenario.into_iter().chain(number).chain(["value"]).collect();
    let columns = (found.join(", "), expected.join(", "));
    found.sort_unstable();
    expected.sort_unstable();
    if found == expected {
        Ok(each)
    } else {
        Err(format!("it gives the columns {} instead of {}", columns.0, columns.1))
    }
}
