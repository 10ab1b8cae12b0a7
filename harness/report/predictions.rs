//! Predictions of single elements along test episodes, beside the references.

use harness_catalog::rows;
use harness_figures::FigureError;
use harness_figures::source::Runs;
use harness_spec::{Modality, Origin};
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;

/// An element of a modality that networks of one latent size predict in one scenario.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct Of {
    pub modality: Modality,
    pub scenario: Origin,
    pub latent: u64,
    /// The index of the element.
    pub index: usize,
}

/// A row of the predictions table.
#[derive(Deserialize)]
pub struct Sample {
    #[serde(flatten)]
    pub of: Of,
    /// The seed of the network.
    pub seed: u64,
    pub episode: u32,
    pub sample: u32,
    pub reference: f64,
    pub predicted: f64,
}

/// Returns the predictions of the networks with the lowest seeds that meet a condition of SQL, sorted by episode and
/// sample.
///
/// # Errors
/// When there are none, or a table can't be read.
pub fn predictions(runs: &Runs, condition: &str) -> Result<Vec<Sample>, FigureError> {
    let mut answer = runs.query_first_seeds(&format!(
        "select modality, scenario, latent, index, seed, episode, sample, reference, predicted from predictions \
         where task = 'prediction' and {condition} and latent is not null order by episode, sample"
    ))?;
    Ok(rows(&mut answer)?)
}

/// At most so many of a number of elements, evenly chosen, with the first and the last one.
pub fn evenly(width: usize, most: usize) -> BTreeSet<usize> {
    let count = width.min(most);
    (0..count).map(|place| place * (width - 1) / count.saturating_sub(1).max(1)).collect()
}
