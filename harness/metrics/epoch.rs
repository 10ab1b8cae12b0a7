//! The losses that training logs in each epoch.

use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Mean of every loss term over a split, on normalized values and before weighting. `total` is the weighted sum.
pub type Losses = BTreeMap<String, f64>;

/// The name of the weighted sum of all terms.
pub const TOTAL: &str = "total";

/// The losses and the duration of one epoch.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Epoch {
    /// Number of the epoch, counted from 1.
    pub epoch: usize,
    /// Losses on the training samples, with dropout and latent noise.
    pub train: Losses,
    /// Losses on the validation samples.
    pub validation: Losses,
    /// Wall time of the epoch, s.
    pub seconds: f64,
}
