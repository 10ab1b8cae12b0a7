//! Rows of the tables of metrics.

use harness_spec::{Modality, Task};
use serde::Deserialize;

/// A row of a table of metrics.
#[derive(Clone, Deserialize)]
pub(super) struct Row {
    pub experiment: String,
    pub run: String,
    pub task: Task,
    pub model: String,
    pub modality: Modality,
    pub direction: Option<String>,
    pub metric: String,
    pub value: f64,
    pub unit: String,
    /// `None` in the table without horizons, and for a metric that has none.
    #[serde(default)]
    pub horizon: Option<usize>,
}
