//! Metrics that are not defined, because what they judge does not change in the test samples.

use super::{Analysis, Run};
use harness_catalog::{OVERALL, QueryError, rows};
use harness_metrics::Metric;
use harness_shared::numbers::enumerated;
use harness_spec::{Modality, Task};
use harness_tables::schema::{GIVEN, HORIZON, Table};
use serde::Deserialize;
use std::collections::{BTreeMap, BTreeSet};

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

/// A metric that lacks its value.
#[derive(Deserialize)]
struct Row {
    experiment: String,
    run: String,
    modality: Modality,
    direction: Option<String>,
    metric: String,
    horizon: Option<usize>,
}

impl Analysis {
    /// The metrics of predictions that lack a value in runs that count: at these horizons, in samples, or of the next
    /// sample, and of these modalities or parts of them, or of all if there are none.
    ///
    /// # Errors
    /// When a table is damaged.
    pub fn undefined(
        &self,
        horizons: Option<&BTreeSet<usize>>,
        modalities: &[String],
    ) -> Result<Undefined, QueryError> {
        let experiments: Vec<&str> = self.experiments().collect();
        let (table, horizon, further) = match horizons {
            Some(all) => {
                let all: Vec<String> = all.iter().map(usize::to_string).collect();
                let further = format!("and {GIVEN} is null and {HORIZON} in ({})", all.join(", "));
                (Table::AllMetrics, format!(", {HORIZON}"), further)
            }
            None => (Table::Metrics, String::new(), String::new()),
        };
        let sql = format!(
            "select distinct experiment, run, modality, direction, metric{horizon} from {} \
             where task = '{}' and {OVERALL} and value is null {further}",
            table.name(),
            Task::Prediction
        );
        let all: Vec<Row> = rows(&mut self.query(&experiments, &sql)?)?;
        let runs: Vec<&Run> = self.experiments().flat_map(|name| self.runs(name)).collect();
        let scenarios: BTreeSet<_> = runs.iter().map(|run| &run.record.spec.scenario).collect();
        let mut undefined = Undefined::default();
        for Row { experiment, run, modality, direction, metric, horizon } in all {
            let own = runs.iter().find(|one| one.record.run == run && one.record.experiment == experiment);
            let Some(own) = own.filter(|_| Undefined::may_lack(&metric)) else { continue };
            let part = direction.map(|part| format!(" {part}")).unwrap_or_default();
            let what = format!("{modality}{part}");
            let is_own = |asked: &String| *asked == what || asked == modality.name();
            if !modalities.is_empty() && !modalities.iter().any(is_own) {
                continue;
            }
            let place = [
                (experiments.len() > 1).then_some(experiment.as_str()),
                (scenarios.len() > 1).then_some(own.record.spec.scenario.name()),
            ];
            let place = place.into_iter().flatten().collect::<Vec<_>>().join(", ");
            let place = if place.is_empty() { place } else { format!("{place}: ") };
            undefined.add(&format!("{place}{what}"), horizon, &metric);
        }
        Ok(undefined)
    }
}
