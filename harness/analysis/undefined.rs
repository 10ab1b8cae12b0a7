//! Metrics that are not defined, because what they judge does not change in the test samples.

use super::{Analysis, Run};
use harness_catalog::{OVERALL, QueryError, rows};
use harness_metrics::Metric;
use harness_spec::{Modality, Task};
use serde::Deserialize;
use std::collections::{BTreeMap, BTreeSet};

/// The metrics that lack a value, by what they judge.
#[derive(Debug, Clone, Default)]
pub struct Undefined(BTreeMap<String, BTreeSet<String>>);

impl Undefined {
    /// Notes that a metric has no value. `of` is a modality or a part of it, and says where if that matters.
    pub fn add(&mut self, of: &str, metric: &str) {
        self.0.entry(of.to_owned()).or_default().insert(metric.to_owned());
    }

    /// Returns a sentence for each thing that lacks one of the metrics for which `is_wanted` is true: `contact_force is
    /// 0 in all test samples, so its r2 and wmape are not defined`.
    pub fn sentences(&self, is_wanted: impl Fn(&str) -> bool) -> Vec<String> {
        let sentence = |(of, metrics): (&String, &BTreeSet<String>)| {
            let wanted: Vec<&str> =
                metrics.iter().map(String::as_str).filter(|metric| is_wanted(metric)).collect();
            // This error is relative to the sum of the values.
            let is = if metrics.contains(Metric::Wmape.name()) { "is 0" } else { "does not change" };
            let verb = if wanted.len() == 1 { "is" } else { "are" };
            let wanted = Some(wanted).filter(|wanted| !wanted.is_empty())?.join(" and ");
            Some(format!("{of} {is} in all test samples, so its {wanted} {verb} not defined"))
        };
        self.0.iter().filter_map(sentence).collect()
    }

    /// Whether a metric lacks its value if the values that it judges are the same in all test samples.
    pub fn may_lack(metric: &str) -> bool {
        [Metric::R2, Metric::Wmape, Metric::RelativeError].iter().any(|other| other.name() == metric)
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
}

impl Analysis {
    /// The metrics of predictions of the next sample that lack a value in runs that count.
    ///
    /// # Errors
    /// When a table is damaged.
    pub fn undefined(&self) -> Result<Undefined, QueryError> {
        let experiments: Vec<&str> = self.experiments().collect();
        let sql = format!(
            "select distinct experiment, run, modality, direction, metric from metrics \
             where task = '{}' and {OVERALL} and value is null",
            Task::Prediction
        );
        let all: Vec<Row> = rows(&mut self.query(&experiments, &sql)?)?;
        let runs: Vec<&Run> = self.experiments().flat_map(|name| self.runs(name)).collect();
        let scenarios: BTreeSet<_> = runs.iter().map(|run| &run.record.spec.scenario).collect();
        let mut undefined = Undefined::default();
        for Row { experiment, run, modality, direction, metric } in all {
            let own = runs.iter().find(|one| one.record.run == run && one.record.experiment == experiment);
            let Some(own) = own.filter(|_| Undefined::may_lack(&metric)) else { continue };
            let place = (scenarios.len() > 1).then(|| format!("{}: ", own.record.spec.scenario.name()));
            let part = direction.map(|part| format!(" {part}"));
            undefined.add(
                &[place, Some(modality.to_string()), part].into_iter().flatten().collect::<String>(),
                &metric,
            );
        }
        Ok(undefined)
    }
}
