//! Collects predictions and references at the fingertip.

use super::joints::{Value, value};
use super::{Absent, of_both, short};
use harness_analysis::intervals;
use harness_figures::FigureError;
use harness_figures::source::{Runs, Source, Study};
use harness_metrics::Direction;
use harness_registry::rows;
use harness_spec::{Modality, Scenario};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};

/// Largest number of points in each cloud. More points would hide each other.
const POINTS: usize = 300;

/// One network's predictions of one joint or link.
#[derive(Serialize)]
pub struct Cloud {
    #[serde(flatten)]
    of: Of,
    study: &'static str,
    input: &'static str,
    unit: &'static str,
    /// The seed of the network whose predictions are shown.
    seed: u64,
    /// R² over all test samples, as a mean over seeds. `None` if it isn't defined.
    r2: Option<Value>,
    /// Episode, sample, reference and prediction of each point, sorted by episode and sample.
    points: Vec<(u32, u32, f64, f64)>,
}

/// What a cloud shows.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
struct Of {
    modality: Modality,
    scenario: Scenario,
    latent: u64,
    /// The index of the joint or link, 0 at the finger's base.
    index: usize,
}

/// A row of the predictions table.
#[derive(Deserialize)]
struct Sample {
    #[serde(flatten)]
    of: Of,
    seed: u64,
    episode: u32,
    sample: u32,
    reference: f64,
    predicted: f64,
}

/// An R² of the metrics table.
#[derive(Deserialize)]
struct Score {
    #[serde(flatten)]
    of: Of,
    dataset_seed: u64,
    value: Option<f64>,
}

/// Returns the clouds of both studies, and a reason for each study without runs.
///
/// # Errors
/// When a table can't be read.
pub fn clouds(source: &Source) -> Result<(Vec<Cloud>, BTreeSet<Absent>), FigureError> {
    of_both(source, of_study)
}

fn of_study(runs: &Runs, study: Study) -> Result<Vec<Cloud>, FigureError> {
    let definition = &runs.layout()[Modality::PROPRIOCEPTION];
    let tip = |direction: Direction| direction.elements(definition).last().copied().unwrap_or_default();
    let [flexion, abduction] = Direction::FINGER.map(tip);
    let place = format!(
        "task = 'prediction' and modality in ('proprioception', 'contact_force') \
         and index in ({flexion}, {abduction})"
    );
    let mut answer = runs.query(&format!(
        "select modality, scenario, latent, index, dataset_seed, value \
         from metrics join runs using (experiment, run, scenario, latent) \
         where {place} and metric = 'r2' and model = 'network'"
    ))?;
    let scores = rows::<Score>(&mut answer)?;
    let r2 = intervals(scores.into_iter().map(|score| (score.of, score.dataset_seed, score.value)));

    let mut answer = runs.query_first_seeds(&format!(
        "select modality, scenario, latent, index, seed, episode, sample, reference, predicted from predictions \
         where {place} order by episode, sample"
    ))?;
    let mut samples: BTreeMap<Of, Vec<Sample>> = BTreeMap::new();
    for sample in rows::<Sample>(&mut answer)? {
        samples.entry(sample.of.clone()).or_default().push(sample);
    }
    let cloud = |(of, samples): (Of, Vec<Sample>)| Cloud {
        study: study.name(),
        input: study.input(),
        unit: if of.modality == Modality::PROPRIOCEPTION { "rad" } else { "N" },
        seed: samples[0].seed,
        r2: r2.get(&of).map(value),
        points: points(&samples),
        of,
    };
    Ok(samples.into_iter().map(cloud).collect())
}

/// Chooses points evenly over the test samples, so that all episodes are represented equally.
fn points(samples: &[Sample]) -> Vec<(u32, u32, f64, f64)> {
    let count = samples.len().min(POINTS);
    let chosen = (0..count).map(|point| &samples[point * samples.len() / count]);
    chosen.map(|of| (of.episode, of.sample, short(of.reference), short(of.predicted))).collect()
}
