//! The metric of a claim, and what it stands for in texts and queries.

use harness_metrics::Metric;
use serde::de::Error;
use serde::{Deserialize, Deserializer};

/// The metric by which a claim compares predictions.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct ClaimMetric(Metric);

impl ClaimMetric {
    /// Where the name stands.
    pub(crate) const NAME: &str = "{metric}";
    /// Where the error stands in queries: an expression of the column `value` that is smaller for better predictions.
    const ERROR: &str = "{error}";
    /// Where the error of predicting zero stands in queries. It is null if it does not follow from the metric's
    /// formula.
    const ZERO: &str = "{zero}";

    /// The name in tables.
    pub(crate) fn name(self) -> &'static str {
        self.0.name()
    }

    /// The place in a query that only a claim with a metric can fill, if there is one.
    pub(crate) fn place_in(query: &str) -> Option<&'static str> {
        [Self::NAME, Self::ERROR, Self::ZERO].into_iter().find(|place| query.contains(place))
    }

    /// Inserts the metric in a text.
    pub(crate) fn complete(self, text: &str) -> String {
        text.replace(Self::NAME, self.name())
            .replace(Self::ERROR, self.error())
            .replace(Self::ZERO, self.zero())
    }

    /// R2 is one minus a relative squared error. All other metrics are errors.
    fn error(self) -> &'static str {
        if self.0.higher_is_better() { "(1 - value)" } else { "value" }
    }

    /// Predicting zero has an error of 100 % of what percentages are relative to.
    fn zero(self) -> &'static str {
        let metric = match self.0 {
            Metric::Regional(metric, _) => *metric,
            metric => metric,
        };
        if matches!(metric, Metric::Smape | Metric::Wmape) { "100" } else { "null" }
    }
}

impl<'de> Deserialize<'de> for ClaimMetric {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let name = String::deserialize(deserializer)?;
        let metric = name
            .parse::<Metric>()
            .map_err(|allowed| D::Error::custom(format!("'{name}' is no metric; {allowed}")))?;
        if Metric::DERIVED.contains(&metric) {
            return Err(D::Error::custom(format!("'{name}' is in no table; use one that is, such as r2")));
        }
        Ok(Self(metric))
    }
}
