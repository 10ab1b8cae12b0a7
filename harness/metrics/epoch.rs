//! What training measures in each epoch.

use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Mean of every term of the loss over a split, on normalized values and before weighting; `total` is the
/// weighted sum.
pub type Losses = BTreeMap<String, f64>;

/// Name of the weighted sum of all terms.
pub const TOTAL: &str = "total";

/// What one epoch gave.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Epoch {
    /// Counted from 1.
    pub epoch: usize,
    pub train: Losses,
    pub validation: Losses,
    pub seconds: f64,
}
