//! Collects predictions and references at the fingertip.

use super::joints::{Value, value};
use super::subjects::{Subject, direction_of, of_each};
use super::{Absent, Asked, short};
use harness_analysis::intervals;
use harness_catalog::rows;
use harness_figures::FigureError;
use harness_figures::source::{Runs, Source};
use harness_metrics::Direction;
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
    /// The name of the study or experiment.
    study: String,
    /// What tells its networks apart, in words.
    input: String,
    unit: &'static str,
    /// The direction of the joint or link.
    direction: Option<&'static str>,
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

/// Returns the clouds of all subjects, and a reason for each subject without runs.
///
/// # Errors
/// When a table can't be read.
pub fn clouds(
    source: &Source,
    subjects: &[Subject],
    asked: &Asked,
) -> Result<(Vec<Cloud>, BTreeSet<Absent>), FigureError> {
    of_each(source, subjects, asked, of_subject)
}

fn of_subject(runs: &Runs, subject: &Subject) -> Result<Vec<Cloud>, FigureError> {
    let layout = runs.layout();
    let tips = [Modality::PROPRIOCEPTION, Modality::CONTACT_FORCE].into_iter().filter_map(|modality| {
        let definition = layout.get(modality)?;
        let last = Direction::FINGER.iter().filter_map(|direction| direction.elements(definition).last());
        let last: Vec<String> = last.map(usize::to_string).collect();
        Some(format!("modality = '{modality}' and index in ({})", last.join(", ")))
    });
    let place = format!(
        "task = 'prediction' and modality in ('proprioception', 'contact_force') and ({})",
        tips.collect::<Vec<_>>().join(" or ")
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
         where {place} and latent is not null order by episode, sample"
    ))?;
    let mut samples: BTreeMap<Of, Vec<Sample>> = BTreeMap::new();
    for sample in rows::<Sample>(&mut answer)? {
        samples.entry(sample.of.clone()).or_default().push(sample);
    }
    let cloud = |(of, samples): (Of, Vec<Sample>)| Cloud {
        study: subject.name.clone(),
        input: subject.words.clone(),
        unit: if of.modality == Modality::PROPRIOCEPTION { "rad" } else { "N" },
        direction: direction_of(&layout[of.modality], of.index).map(Direction::name),
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
