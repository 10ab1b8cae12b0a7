//! Tests the paper's statements on the tables of runs.
//!
//! A claim is a statement with a query and a condition on the query's result.

mod file;
mod metric;
mod plan;
mod readings;
mod table;

pub use file::load;
pub use plan::{More, Plan, Step, plan};
pub use readings::{Matrix, Readings, Row as MatrixRow};
pub use table::table;

use harness_analysis::{
    Analysis, AnalysisError, Interval, LEVEL, Mixed, Run, Selection, Setting, Subset, holm, mean_interval,
    p_value, replicates,
};
use harness_registry::{Registry, rows};
use harness_spec::{Origin, QUICK, Scenario, SpecError, nearest};
use metric::Metric;
use polars::prelude::DataFrame;
use serde::de::Error;
use serde::{Deserialize, Deserializer};
use serde_yaml::Spanned;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt;

/// A statement of the paper, and how to test it.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Claim {
    id: Spanned<String>,
    /// A summary of the paper's statement.
    pub paper: String,
    /// The paper's section and figure.
    pub section: String,
    /// A description of the query's value, with its unit.
    pub measured: String,
    /// The scenarios that are judged one by one. Empty if the claim is about both scenarios together.
    #[serde(default, deserialize_with = "scenarios_of_the_paper")]
    pub scenarios: Vec<Scenario>,
    /// The experiments whose tables the queries read.
    pub experiments: Vec<String>,
    /// The latent sizes that replace `{experiment}` in the queries. Their number replaces `{experiment.runs}`.
    #[serde(default)]
    pub latent: Sizes,
    /// The metric by which the claim compares predictions. It is inserted in the claim and in its requirement.
    metric: Option<Spanned<Metric>>,
    /// A condition without which the claim can't be tested. The claim is not testable if it does not hold or is
    /// undecided.
    pub requires: Option<Requirement>,
    query: Spanned<String>,
    /// The condition that the query's value satisfies if the claim holds.
    pub condition: Condition,
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

/// Reads scenarios, and refuses those that the paper does not have.
fn scenarios_of_the_paper<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<Scenario>, D::Error> {
    let scenarios = Vec::<Spanned<Scenario>>::deserialize(deserializer)?;
    let other = scenarios.iter().find(|scenario| !Scenario::PAPER.contains(&scenario.value));
    if let Some(other) = other {
        let names = Scenario::PAPER.map(Scenario::name).join(", ");
        return Err(D::Error::custom(format!("unknown scenario `{}`, expected one of {names}", other.value)));
    }
    Ok(scenarios.into_iter().map(|scenario| scenario.value).collect())
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

    /// The claim's query, completed, over the runs of the experiments or, if `quick`, over their quick runs.
    pub fn sql(&self, quick: bool) -> String {
        self.complete(&self.query.value, &self.latent, quick)
    }

    /// The requirement's query, completed, or `None` without a requirement.
    pub fn required_sql(&self, quick: bool) -> Option<String> {
        let requirement = self.requires.as_ref()?;
        Some(self.complete(&requirement.query.value, &self.latent, quick))
    }

    /// The queries of the claim and of its requirement, as they are in the file.
    fn queries(&self) -> impl Iterator<Item = &Spanned<String>> {
        std::iter::once(&self.query).chain(self.requires.as_ref().map(|requirement| &requirement.query))
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

/// A condition on a measured value. It is written as `above NUMBER` or `below NUMBER`.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(try_from = "String")]
pub enum Condition {
    /// The value is greater than the bound.
    Above(f64),
    /// The value is less than the bound.
    Below(f64),
}

impl Condition {
    /// The bound, in the unit of the value.
    pub fn bound(self) -> f64 {
        let (Self::Above(bound) | Self::Below(bound)) = self;
        bound
    }

    /// Whether a value satisfies the condition.
    pub fn satisfied_by(self, value: f64) -> bool {
        match self {
            Self::Above(bound) => value > bound,
            Self::Below(bound) => value < bound,
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
        }
    }
}

impl TryFrom<String> for Condition {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        let refused = || format!("'{text}' is not a condition; write 'above NUMBER' or 'below NUMBER'");
        let (word, bound) = text.trim().split_once(' ').ok_or_else(refused)?;
        let bound: f64 = bound.trim().parse().map_err(|_| refused())?;
        match word {
            _ if !bound.is_finite() => Err(refused()),
            "above" => Ok(Self::Above(bound)),
            "below" => Ok(Self::Below(bound)),
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
    /// No claim has the wanted id.
    #[error(
        "no claim is called '{wanted}'; {}",
        nearest.as_ref().map_or("use an id of the file of claims".into(), |id| format!("did you mean '{id}'?"))
    )]
    Unknown {
        /// The wanted id.
        wanted: String,
        /// The id that was probably meant.
        nearest: Option<String>,
    },
    /// A claim's query failed, or its answer does not have the required columns and rows.
    #[error("claim '{id}', query at line {line}: {problem}")]
    Query {
        /// The claim's id.
        id: String,
        /// The line of the file where the query starts, counted from 1.
        line: u64,
        /// What is wrong with the query or its answer.
        problem: String,
    },
}

/// The values that a claim's query returned for one scenario, or for both together. There are none if runs are missing.
#[derive(Debug, Clone, PartialEq)]
pub struct Measured {
    /// Whether there is a value for each seed, for each episode, or for each dataset.
    pub each: Each,
    /// The values, by the seed of the dataset, and by seed or episode. For a value of the whole dataset, the second number
    /// is 0.
    pub values: BTreeMap<(u64, i64), f64>,
}

impl Measured {
    /// The mean over datasets, and over the seeds or episodes of each, with its confidence interval. `None` without
    /// values.
    pub fn interval(&self) -> Option<Interval> {
        mean_interval(&self.replicates(), LEVEL)
    }

    /// The values that the interval is computed from: the means of the datasets or, with one dataset, its values.
    pub fn replicates(&self) -> Vec<f64> {
        replicates(self.values.iter().map(|((dataset, _), value)| (*dataset, *value)))
    }

    /// The seeds of the datasets that have values.
    pub fn datasets(&self) -> BTreeSet<u64> {
        self.values.keys().map(|(dataset, _)| *dataset).collect()
    }
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
            Self::NoData => "undecided: no data",
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
            Some(interval) => self.claim.condition.judge(interval, self.measured.each),
        }
    }

    /// The two-sided p-value of a t-test against the condition's bound. `None` unless the claim holds, does not hold,
    /// or is undecided, and if all values are equal.
    pub fn p_value(&self) -> Option<f64> {
        let is_tested = matches!(self.verdict(), Verdict::Holds | Verdict::DoesNotHold | Verdict::Undecided);
        p_value(&self.measured.replicates(), self.claim.condition.bound()).filter(|_| is_tested)
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
            let nearest = nearest(wanted, &ids).map(str::to_owned);
            return Err(ClaimsError::Unknown { wanted: wanted.clone(), nearest });
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
    let analysis = Analysis::new(registry, &selection(claims, settings, quick))?;
    Ok(expect(analysis, claims, quick))
}

/// The selection of runs for these claims, to which a caller may add experiments.
pub fn selection(claims: &[&Claim], settings: &[Setting], quick: bool) -> Selection {
    let experiments = claims.iter().flat_map(|claim| claim.experiments(quick)).collect();
    // The paper's statements are about the simulated scenarios.
    Selection { experiments, settings: settings.to_vec(), simulated: true }
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
    let by_variant = claim.queries().all(|query| query.value.contains("variant"));
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
        let measure = |query: &Spanned<String>| {
            let sql = claim.complete(&query.value, sizes, quick);
            claim.measure(&datasets, &sql).map_err(|problem| ClaimsError::Query {
                id: claim.id().to_owned(),
                line: query.defined.line(),
                problem,
            })
        };
        let measured = measure(&claim.query)?;
        let required = claim.requires.as_ref().map(|requires| measure(&requires.query)).transpose()?;
        let mut required = required.into_iter().flatten();
        let judgment = |(scenario, measured)| {
            let required = required.next().map(|(_, measured)| measured);
            Judgment { claim, scenario, measured, required, mixed: self.mixed.clone() }
        };
        Ok(measured.into_iter().map(judgment).collect())
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

/// A row of a query's answer.
#[derive(Deserialize)]
struct Row {
    scenario: Option<Origin>,
    #[serde(alias = "episode", default)]
    seed: i64,
    value: Option<f64>,
}

impl Claim {
    /// The values of a query on all datasets, for each of the claim's scenarios, or for both together.
    fn measure(
        &self,
        datasets: &[(u64, Subset)],
        sql: &str,
    ) -> Result<Vec<(Option<Scenario>, Measured)>, String> {
        let scenarios: Vec<Option<Scenario>> = match self.scenarios.as_slice() {
            [] => vec![None],
            scenarios => scenarios.iter().copied().map(Some).collect(),
        };
        let empty = |scenario| (scenario, Measured { each: Each::Seed, values: BTreeMap::new() });
        let mut found: Vec<_> = scenarios.into_iter().map(empty).collect();
        for (dataset, runs) in datasets {
            let mut answer = runs.query(sql).map_err(|error| error.to_string())?;
            let each = self.check_columns(&answer)?;
            let rows: Vec<Row> = rows(&mut answer).map_err(|error| error.to_string())?;
            for (scenario, measured) in &mut found {
                measured.each = each;
                for row in rows.iter().filter(|row| row.scenario == scenario.map(Origin::from)) {
                    // An undefined value counts as not measured.
                    let key = (*dataset, row.seed);
                    if row.value.is_some_and(|value| measured.values.insert(key, value).is_some()) {
                        let (name, seed) = (each.name(), row.seed);
                        return Err(match each {
                            Each::Dataset => "it gives several values; group by scenario".to_owned(),
                            _ => {
                                format!("it gives {name} {seed} several values; group by scenario and {name}")
                            }
                        });
                    }
                }
            }
        }
        Ok(found)
    }

    /// Checks the columns of a query's answer. Returns whether a row is a seed, an episode or a dataset.
    fn check_columns(&self, answer: &DataFrame) -> Result<Each, String> {
        let mut found: Vec<&str> = answer.get_column_names().into_iter().map(|name| name.as_str()).collect();
        let scenario = (!self.scenarios.is_empty()).then_some("scenario");
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
}
