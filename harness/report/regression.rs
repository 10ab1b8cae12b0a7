//! Collects predictions and references of single elements, which are the fingertip's if there is a finger.

use super::joints::{Value, value};
use super::predictions::{Of, Sample, evenly, predictions};
use super::subjects::{Subject, direction_of, of_each};
use super::{Absent, Asked, short};
use harness_analysis::intervals;
use harness_catalog::rows;
use harness_figures::FigureError;
use harness_figures::source::{Runs, Source};
use harness_metrics::Direction;
use harness_spec::Definition;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};

/// Largest number of points in each cloud. More points would hide each other.
const POINTS: usize = 300;
/// Largest number of elements of a modality.
const ELEMENTS: usize = 8;

/// One network's predictions of one joint or link.
#[derive(Serialize)]
pub struct Cloud {
    #[serde(flatten)]
    of: Of,
    /// The name of the study or experiment.
    study: String,
    /// What tells its networks apart, in words.
    input: String,
    unit: String,
    /// The name of the element.
    element: String,
    /// The direction of the joint or link, if it is one of the paper's two.
    direction: Option<&'static str>,
    /// The seed of the network whose predictions are shown.
    seed: u64,
    /// R² over all test samples, as a mean over seeds. `None` if it isn't defined.
    r2: Option<Value>,
    /// Episode, sample, reference and prediction of each point, sorted by episode and sample.
    points: Vec<(u32, u32, f64, f64)>,
}

/// An R² of the metrics table.
#[derive(Deserialize)]
struct Score {
    #[serde(flatten)]
    of: Of,
    /// `None` for an imported dataset.
    dataset_seed: Option<u64>,
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
    let definitions = subject.modalities.iter().filter_map(|modality| layout.get(*modality));
    let tips = definitions.map(|definition| {
        let shown: Vec<String> = shown(definition).iter().map(usize::to_string).collect();
        format!("modality = '{}' and index in ({})", definition.name, shown.join(", "))
    });
    let tips: Vec<String> = tips.collect();
    if tips.is_empty() {
        return Err(runs.no_rows());
    }
    let place = format!("({})", tips.join(" or "));
    let mut answer = runs.query(&format!(
        "select modality, scenario, latent, index, dataset_seed, value \
         from metrics join runs using (experiment, run, scenario, latent) \
         where task = 'prediction' and {place} and metric = 'r2' and model = 'network'"
    ))?;
    let scores = rows::<Score>(&mut answer)?;
    let r2 = intervals(
        scores.into_iter().map(|score| (score.of, score.dataset_seed.unwrap_or_default(), score.value)),
    );

    let mut samples: BTreeMap<Of, Vec<Sample>> = BTreeMap::new();
    for sample in predictions(runs, &place)? {
        samples.entry(sample.of.clone()).or_default().push(sample);
    }
    let cloud = |(of, samples): (Of, Vec<Sample>)| {
        let definition = layout.get(of.modality)?;
        let element = definition.elements().get(of.index)?;
        Some(Cloud {
            study: subject.name.clone(),
            input: subject.words.clone(),
            unit: element.unit.clone(),
            element: element.name.clone(),
            direction: direction_of(definition, of.index).map(Direction::name),
            seed: samples[0].seed,
            r2: r2.get(&of).map(value),
            points: points(&samples),
            of,
        })
    };
    Ok(samples.into_iter().filter_map(cloud).collect())
}

/// The elements that are shown: the last one of each of the paper's directions, which is the fingertip, or else some of
/// all elements, evenly chosen.
fn shown(definition: &Definition) -> BTreeSet<usize> {
    let last = Direction::FINGER.iter().filter_map(|direction| direction.elements(definition).last());
    let last: BTreeSet<usize> = last.copied().collect();
    if last.is_empty() { evenly(definition.width(), ELEMENTS) } else { last }
}

/// Chooses points evenly over the test samples, so that all episodes are represented equally.
fn points(samples: &[Sample]) -> Vec<(u32, u32, f64, f64)> {
    let count = samples.len().min(POINTS);
    let chosen = (0..count).map(|point| &samples[point * samples.len() / count]);
    chosen.map(|of| (of.episode, of.sample, short(of.reference), short(of.predicted))).collect()
}
