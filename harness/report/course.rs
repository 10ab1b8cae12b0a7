//! Collects what was predicted along a test episode, beside the reference.

use super::predictions::{Of, Sample, evenly, predictions};
use super::subjects::{Subject, of_each};
use super::{Absent, Asked, short};
use harness_figures::FigureError;
use harness_figures::source::{Runs, Source};
use harness_spec::{Modality, Origin};
use serde::Serialize;
use std::collections::{BTreeMap, BTreeSet};

/// Largest number of samples in the page.
const SAMPLES: usize = 200;
/// Largest number of elements of a modality in the page. They are evenly chosen.
const ELEMENTS: usize = 24;

/// One network's predictions of an element along a test episode.
#[derive(Serialize)]
pub struct Course {
    #[serde(flatten)]
    of: Of,
    /// The name of the experiment.
    study: String,
    /// What tells its networks apart, in words.
    input: String,
    /// The name of the element.
    element: String,
    unit: String,
    /// The seed of the network whose predictions are shown.
    seed: u64,
    episode: u32,
    /// The time from one sample to the next, s; `None` for an imported dataset.
    seconds: Option<f64>,
    /// Sample, reference and prediction.
    points: Vec<(u32, f64, f64)>,
}

/// Returns the courses of all subjects, and a reason for each subject without runs.
///
/// # Errors
/// When a table can't be read.
pub fn courses(
    source: &Source,
    subjects: &[Subject],
    asked: &Asked,
) -> Result<(Vec<Course>, BTreeSet<Absent>), FigureError> {
    of_each(source, subjects, asked, of_subject)
}

fn of_subject(runs: &Runs, subject: &Subject) -> Result<Vec<Course>, FigureError> {
    let mut found: BTreeMap<(Modality, Origin), Vec<Sample>> = BTreeMap::new();
    for row in predictions(runs, "true")? {
        found.entry((row.of.modality, row.of.scenario.clone())).or_default().push(row);
    }
    let mut courses = Vec::new();
    for ((modality, scenario), rows) in found {
        let run = runs.all.iter().find(|run| run.record.spec.scenario == scenario).unwrap_or(&runs.all[0]);
        let Some(definition) = run.record.layout.get(modality) else { continue };
        let (episode, chosen) = (liveliest(&rows), evenly(definition.width(), ELEMENTS));
        let rate = run.record.spec.simulation.as_ref().map(|simulation| simulation.sample_rate_hz);
        let mut by_element: BTreeMap<Of, Vec<Sample>> = BTreeMap::new();
        for row in rows.into_iter().filter(|row| row.episode == episode && chosen.contains(&row.of.index)) {
            by_element.entry(row.of.clone()).or_default().push(row);
        }
        courses.extend(by_element.into_iter().filter_map(|(of, rows)| {
            let element = definition.elements().get(of.index)?;
            let points = rows.iter().take(SAMPLES);
            Some(Course {
                study: subject.name.clone(),
                input: subject.words.clone(),
                element: element.name.clone(),
                unit: element.unit.clone(),
                seed: rows[0].seed,
                episode,
                seconds: rate.map(|rate| 1.0 / rate),
                points: points.map(|row| (row.sample, short(row.reference), short(row.predicted))).collect(),
                of,
            })
        }));
    }
    Ok(courses)
}

/// The test episode in which the references vary most. Of equal ones, it is the first.
fn liveliest(rows: &[Sample]) -> u32 {
    let mut sums: BTreeMap<(u32, usize), [f64; 3]> = BTreeMap::new();
    for row in rows {
        let [count, sum, squares] = sums.entry((row.episode, row.of.index)).or_default();
        (*count, *sum, *squares) =
            (*count + 1.0, *sum + row.reference, *squares + row.reference * row.reference);
    }
    let mut spread: BTreeMap<u32, f64> = BTreeMap::new();
    for ((episode, _), [count, sum, squares]) in sums {
        *spread.entry(episode).or_default() += squares / count - (sum / count) * (sum / count);
    }
    let most = spread.values().copied().fold(f64::MIN, f64::max);
    spread.into_iter().find(|(_, value)| *value == most).map_or(0, |(episode, _)| episode)
}
