//! Metrics that are not defined, because what they judge does not change in the test samples.

use super::rows::Row;
use super::{Analysis, predicted};
use harness_metrics::Metric;
use harness_shared::numbers::enumerated;
use harness_spec::Task;
use std::collections::{BTreeMap, BTreeSet, HashMap};

/// The metrics that lack a value, by what they judge and, if it matters, by the horizon in samples.
#[derive(Debug, Clone, Default)]
pub struct Undefined(BTreeMap<String, BTreeMap<Option<usize>, BTreeSet<String>>>);

impl Undefined {
    /// Notes that a metric has no value. `of` is a modality or a part of it, and says where if that matters.
    pub fn add(&mut self, of: &str, horizon: Option<usize>, metric: &str) {
        let horizons = self.0.entry(of.to_owned()).or_default();
        horizons.entry(horizon).or_default().insert(metric.to_owned());
    }

    /// Returns a sentence for each thing that lacks one of the metrics for which `is_wanted` is true: `contact_force is
    /// 0 in all test samples, so its r2 and wmape are not defined`. Horizons with the same metrics share a sentence.
    pub fn sentences(&self, is_wanted: impl Fn(&str) -> bool) -> Vec<String> {
        let mut sentences = Vec::new();
        for (of, horizons) in &self.0 {
            let mut alike: BTreeMap<&BTreeSet<String>, Vec<usize>> = BTreeMap::new();
            for (horizon, metrics) in horizons {
                alike.entry(metrics).or_default().extend(horizon);
            }
            for (metrics, horizons) in alike {
                let wanted: Vec<String> =
                    metrics.iter().filter(|metric| is_wanted(metric)).cloned().collect();
                if wanted.is_empty() {
                    continue;
                }
                // This error is relative to the sum of the values.
                let is = if metrics.contains(Metric::Wmape.name()) { "is 0" } else { "does not change" };
                let verb = if wanted.len() == 1 { "is" } else { "are" };
                let (at, wanted) = (at_horizons(&horizons), enumerated(&wanted));
                sentences
                    .push(format!("{of} {is} in all test samples{at}, so its {wanted} {verb} not defined"));
            }
        }
        sentences
    }

    /// Whether a metric lacks its value if the values that it judges are the same in all test samples.
    pub fn may_lack(metric: &str) -> bool {
        [Metric::R2, Metric::Wmape, Metric::RelativeError].iter().any(|other| other.name() == metric)
    }
}

/// Says at which of the sorted horizons something is so: ` of horizon 1`, ` of horizons 1 and 2` or ` of horizons 1 to
/// 20`. Empty if there are none.
fn at_horizons(horizons: &[usize]) -> String {
    let words: Vec<String> = horizons.iter().map(usize::to_string).collect();
    match horizons {
        [] => String::new(),
        [one] => format!(" of horizon {one}"),
        [first, .., last] if words.len() > 2 && last - first + 1 == words.len() => {
            format!(" of horizons {first} to {last}")
        }
        _ => format!(" of horizons {}", enumerated(&words)),
    }
}

/// The metrics of predictions that lack a value among `rows`: those of these modalities or parts of them, or of all if
/// there are none.
pub(super) fn undefined(analysis: &Analysis, rows: &[Row<'_>], of: &[String]) -> Undefined {
    let runs = || analysis.experiments().flat_map(|name| analysis.runs(name)).map(|run| &run.record);
    let scenarios: HashMap<_, _> =
        runs().map(|run| ((&*run.experiment, &*run.run), &run.spec.scenario)).collect();
    let several = scenarios.values().collect::<BTreeSet<_>>().len() > 1;
    let several_experiments = analysis.experiments().count() > 1;
    let is_prediction = |row: &&Row| row.task == Task::Prediction;
    let horizons: BTreeSet<_> = rows.iter().filter(is_prediction).filter_map(|row| row.horizon).collect();
    let lacks = |row: &&Row| row.value.is_none() && Undefined::may_lack(row.metric);
    let mut undefined = Undefined::default();
    for row in rows.iter().filter(is_prediction).filter(lacks) {
        let what = predicted(row.modality, row.direction);
        let is_own = |asked: &String| *asked == what || asked == row.modality.name();
        let Some(scenario) = scenarios.get(&(row.experiment, row.run)) else { continue };
        if !of.is_empty() && !of.iter().any(is_own) {
            continue;
        }
        let experiment = several_experiments.then_some(row.experiment);
        let place = experiment.into_iter().chain(several.then_some(scenario.name()));
        let place = place.collect::<Vec<_>>().join(", ");
        let place = if place.is_empty() { place } else { format!("{place}: ") };
        let horizon = row.horizon.filter(|_| horizons.len() > 1);
        undefined.add(&format!("{place}{what}"), horizon, row.metric);
    }
    undefined
}
