//! The metric of a claim, and what it stands for in queries.

use serde::Deserialize;

/// The name of a metric in tables, such as `wmape` or `r2_box`.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(try_from = "String")]
pub struct Metric(String);

impl Metric {
    /// Where the name stands.
    pub(crate) const NAME: &str = "{metric}";
    /// Where the error stands in queries: an expression of the column `value` that is smaller for better predictions.
    const ERROR: &str = "{error}";
    /// Where the error of predicting zero stands in queries. It is null if it does not follow from the metric's formula.
    const ZERO: &str = "{zero}";

    /// The place in a query that only a claim with a metric can fill, if there is one.
    pub(crate) fn place_in(query: &str) -> Option<&'static str> {
        [Self::NAME, Self::ERROR, Self::ZERO].into_iter().find(|place| query.contains(place))
    }

    /// Inserts the metric in a text.
    pub(crate) fn complete(&self, text: &str) -> String {
        text.replace(Self::NAME, &self.0).replace(Self::ERROR, self.error()).replace(Self::ZERO, self.zero())
    }

    /// The name without the kind of contact: `r2` for `r2_box`.
    fn formula(&self) -> &str {
        self.0.split('_').next().unwrap_or_default()
    }

    /// R2 is one minus a relative squared error. All other metrics are errors.
    fn error(&self) -> &'static str {
        if self.formula() == "r2" { "(1 - value)" } else { "value" }
    }

    /// Predicting zero has an error of 100 % of what percentages are relative to.
    fn zero(&self) -> &'static str {
        if matches!(self.formula(), "smape" | "wmape") { "100" } else { "null" }
    }
}

impl TryFrom<String> for Metric {
    type Error = String;

    fn try_from(name: String) -> Result<Self, String> {
        let is_part = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_';
        if name.is_empty() || !name.chars().all(is_part) {
            return Err(format!(
                "'{name}' can't name a metric; use a name of docs/metrics.md, such as wmape or r2_box"
            ));
        }
        Ok(Self(name))
    }
}
