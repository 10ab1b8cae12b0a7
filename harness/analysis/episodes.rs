//! How much a value would change with other test episodes.

use super::interval::{mean_of, two_sided};
use super::rows::Row;
use super::{Analysis, Estimate, Interval, QueryError};
use harness_metrics::Metric;
use harness_spec::Task;
use harness_tables::schema::{GIVEN, HORIZON, Table};
use polars::prelude::*;
use std::collections::{BTreeMap, BTreeSet, HashMap};

/// The changes of a value when each of the test episodes is left out, minus their mean: a jackknife.
#[derive(Debug, Clone, PartialEq)]
pub struct Jackknife {
    changes: Vec<f64>,
}

impl Jackknife {
    /// The changes of a metric that is computed from these sums, a numerator and a denominator for each episode. `None`
    /// with fewer than two episodes, and if the metric is not defined without one of them.
    pub fn new(metric: Metric, sums: &[[f64; 2]]) -> Option<Self> {
        let all = sums.iter().fold([0.0; 2], |all, own| [all[0] + own[0], all[1] + own[1]]);
        let without = |own: &[f64; 2]| metric.of_sums([(all[0] - own[0]).max(0.0), all[1] - own[1]]);
        let values: Vec<f64> = sums.iter().map(without).collect::<Option<_>>()?;
        let mean = mean_of(&values).filter(|_| values.len() > 1)?;
        Some(Self { changes: values.iter().map(|value| value - mean).collect() })
    }

    /// Number of episodes.
    pub fn episodes(&self) -> usize {
        self.changes.len()
    }

    /// The changes of the difference between two values on the same episodes; `None` if their numbers differ.
    pub fn minus(&self, other: &Self) -> Option<Self> {
        let pairs = self.changes.iter().zip(&other.changes);
        (self.episodes() == other.episodes()).then(|| Self { changes: pairs.map(|(a, b)| a - b).collect() })
    }

    /// The changes of the mean over datasets of values on the same episodes. `datasets` has the seed of each value's
    /// dataset. `None` without values, and if the numbers of episodes differ.
    pub fn mean(values: &[Self], datasets: &[u64]) -> Option<Self> {
        let episodes = values.first()?.episodes();
        if values.iter().any(|value| value.episodes() != episodes) {
            return None;
        }
        let mut counts: BTreeMap<u64, usize> = BTreeMap::new();
        datasets.iter().for_each(|dataset| *counts.entry(*dataset).or_default() += 1);
        let mut changes = vec![0.0; episodes];
        for (value, dataset) in values.iter().zip(datasets) {
            let all = (counts.len() * counts[dataset]) as f64;
            changes.iter_mut().zip(&value.changes).for_each(|(sum, change)| *sum += change / all);
        }
        Some(Self { changes })
    }

    /// Half of the interval at `level` for the mean over all episodes: `t s`. s² = (E - 1) / E Σ c² is the variance by
    /// the jackknife, with the changes c of E episodes. Its mean is not too small (Efron & Stein, 1981, *The jackknife
    /// estimate of variance*, The Annals of Statistics 9). t is the quantile of Student's t with (Σ c²)² / Σ c⁴ degrees
    /// of freedom: those of a sum of squares with one degree of freedom each (Satterthwaite, 1946, *An approximate
    /// distribution of estimates of variance components*, Biometrics Bulletin 2). They are few if a few episodes decide
    /// the value.
    pub fn half(&self, level: f64) -> f64 {
        let sum = |power| self.changes.iter().map(|change| change.powi(power)).sum::<f64>();
        let (squares, most) = (sum(2), self.episodes() as f64 - 1.0);
        if squares == 0.0 {
            return 0.0;
        }
        let freedom = (squares.powi(2) / sum(4)).clamp(1.0, most);
        let variance = squares * most / (most + 1.0);
        two_sided(level, freedom).map_or(f64::INFINITY, |t| t * variance.sqrt())
    }
}

impl Estimate {
    /// The confidence interval at `level` for the mean over all datasets and all test episodes, of values on the same
    /// episodes. Datasets and episodes are crossed: each value is on all of the episodes. The variance of the mean is at
    /// most the sum of both variances (Owen, 2007, *The pigeonhole bootstrap*, The Annals of Applied Statistics 1). The
    /// squares of half of each interval are added (Howe, 1974, *Approximate confidence limits on the mean of X + Y*,
    /// Journal of the American Statistical Association 69).
    ///
    /// # Panics
    /// When `level` is not between 0 and 1.
    pub fn interval_with_episodes(&self, episodes: &Jackknife, level: f64) -> Interval {
        let Interval { mean, bounds } = self.interval(level);
        let half = |high: f64| (high - mean).hypot(episodes.half(level));
        Interval { mean, bounds: bounds.map(|(_, high)| (mean - half(high), mean + half(high))) }
    }

    /// The two-sided p-value that belongs to [`Self::interval_with_episodes`]: 1 minus the highest level at which the
    /// interval excludes `bound`. `None` where [`Self::p_value`] is.
    pub fn p_value_with_episodes(&self, episodes: &Jackknife, bound: f64) -> Option<f64> {
        /// Number of halvings, after which p is known to a ten thousandth of itself.
        const HALVINGS: usize = 20;
        self.p_value(bound)?;
        let excludes = |p: f64| {
            let interval = self.interval_with_episodes(episodes, 1.0 - p);
            bound < interval.low() || interval.high() < bound
        };
        let (mut low, mut high) = (1e-6_f64, 1.0);
        for _ in 0..HALVINGS {
            let middle = (low * high).sqrt();
            if excludes(middle) { high = middle } else { low = middle }
        }
        Some(high)
    }
}

/// The columns of texts that tell what the sums in the rows of the table are of.
const TEXTS: [&str; 8] = ["experiment", "run", "task", "model", GIVEN, "modality", "direction", "metric"];

/// The values of [`TEXTS`] and the horizon.
type Key = (Vec<String>, i64);

/// The jackknives of the values of runs that share a test, from the table `sums`.
pub(super) struct Jackknives(HashMap<Key, Jackknife>);

impl Jackknives {
    /// Those of values that are among `rows`.
    ///
    /// # Errors
    /// When a table is damaged.
    pub(super) fn read(analysis: &Analysis, rows: &[Row]) -> Result<Self, QueryError> {
        let shares = |name: &&str| analysis.runs(name).iter().any(|run| run.record.spec.test.is_some());
        let experiments: Vec<&str> = analysis.experiments().filter(shares).collect();
        let horizons: BTreeSet<i64> = rows.iter().map(horizon).collect();
        if experiments.is_empty() || horizons.is_empty() {
            return Ok(Self(HashMap::new()));
        }
        let horizons: Vec<String> = horizons.iter().map(i64::to_string).collect();
        let is_of_all_inputs = rows.iter().all(|row| row.given.is_none());
        let given = if is_of_all_inputs { format!(" and {GIVEN} is null") } else { String::new() };
        let (texts, horizons, table) = (TEXTS.join(", "), horizons.join(", "), Table::Sums.name());
        let mut found = analysis.query(
            &experiments,
            &format!(
                "select {texts}, {HORIZON}, episode, numerator, denominator from {table} \
                 where {HORIZON} in ({horizons}){given}"
            ),
        )?;
        found.rechunk_mut();
        Ok(Self(jackknives(&found).map_err(QueryError::Sql)?))
    }

    /// The jackknife of the value in a row.
    pub(super) fn of(&self, row: &Row) -> Option<&Jackknife> {
        if self.0.is_empty() {
            return None;
        }
        let Row { experiment, run, task, model, modality, metric, .. } = row;
        let [given, direction] = [row.given, row.direction].map(Option::unwrap_or_default);
        let texts: [&str; 8] =
            [experiment, run, task.name(), model, given, modality.name(), direction, metric];
        self.0.get(&(texts.map(str::to_owned).to_vec(), horizon(row)))
    }
}

/// The horizon of a row; that of the nearest sample if its table has none.
fn horizon(row: &Row) -> i64 {
    row.horizon.map_or(i64::from(row.task == Task::Prediction), |horizon| horizon as i64)
}

/// The jackknife of each key from rows of the table.
fn jackknives(rows: &DataFrame) -> PolarsResult<HashMap<Key, Jackknife>> {
    let texts = TEXTS.map(|name| rows.column(name)?.str());
    let texts = texts.into_iter().collect::<PolarsResult<Vec<_>>>()?;
    let [horizons, episodes] = [HORIZON, "episode"].map(|name| rows.column(name)?.i64());
    let (horizons, episodes) = (horizons?, episodes?);
    let [numerators, denominators] =
        ["numerator", "denominator"].map(|name| rows.column(name)?.cast(&DataType::Float64));
    let (numerators, denominators) = (numerators?, denominators?);
    let (numerators, denominators) = (numerators.f64()?, denominators.f64()?);
    let is_same = |a: &usize, b: &usize| {
        horizons.get(*a) == horizons.get(*b) && texts.iter().all(|text| text.get(*a) == text.get(*b))
    };
    let mut sums: HashMap<Key, Vec<(i64, [f64; 2])>> = HashMap::new();
    for part in Vec::from_iter(0..rows.height()).chunk_by(is_same) {
        let key = texts.iter().map(|text| text.get(part[0]).unwrap_or_default().to_owned()).collect();
        let own = part
            .iter()
            .filter_map(|row| Some((episodes.get(*row)?, [numerators.get(*row)?, denominators.get(*row)?])));
        sums.entry((key, horizons.get(part[0]).unwrap_or_default())).or_default().extend(own);
    }
    let jackknife = |(key, mut sums): (Key, Vec<(i64, [f64; 2])>)| {
        sums.sort_by_key(|(episode, _)| *episode);
        let metric = Metric::named(key.0.last()?)?;
        let sums: Vec<[f64; 2]> = sums.into_iter().map(|(_, sums)| sums).collect();
        Some((key, Jackknife::new(metric, &sums)?))
    };
    Ok(sums.into_iter().filter_map(jackknife).collect())
}
