//! What may be wrong with a recording as the data of an experiment.

use super::ExperimentError;
use harness_dataset::Imported;
use harness_judge::{Given, JudgeError, Ridge, Test, judge};
use harness_metrics::Metric;
use harness_samples::{FramePlace, Normalizers, Partition, Samples};
use harness_shared::progress::Silent;
use harness_spec::{Action, Modality, Scale, Scaling, Scalings, Split, Task, Window};
use std::path::Path;

/// The R2 of a ridge regression above which the setpoint alone tells an output.
const TOLD: f64 = 0.99;

/// Returns what may be wrong with an imported dataset, in sentences. All its vectors count as outputs, and it is divided
/// as by default.
///
/// # Errors
/// When the dataset can't be read.
pub fn recording_notes(datasets: &Path, name: &str) -> Result<Vec<String>, ExperimentError> {
    let samples = Imported::open(datasets, name)?.load(FramePlace::Nowhere, &Silent)?;
    let vectors = samples.layout().stored_vectors().map(|definition| definition.name);
    let output: Vec<Modality> = vectors.filter(|name| name.is_sensed()).collect();
    match samples.partition(&Split::default(), &Window::TRANSITION) {
        Some(partition) => Ok(setpoint_notes(&samples, &output, &partition)?),
        None => Ok(Vec::new()),
    }
}

/// Returns a sentence for each output of a recording that its setpoint contains or tells, because a model reads it off
/// its action then. The regression is fitted to the training samples and judged on those of the test.
///
/// # Errors
/// When a value is not finite.
pub(super) fn setpoint_notes(
    samples: &Samples,
    output: &[Modality],
    partition: &Partition,
) -> Result<Vec<String>, JudgeError> {
    let layout = samples.layout();
    if layout.action().is_empty() {
        return Ok(Vec::new());
    }
    let scaling = Scaling { scale: Scale::PerElement, minimum: None };
    let scalings = Scalings::from([(Modality::SETPOINT, scaling)]);
    let action = Action::Target;
    let normalizers = Normalizers::fit(samples, &partition.training, &scalings, action);
    let given = Given { samples, normalizers: &normalizers, action, input: &[Modality::SETPOINT] };
    let mut notes = Vec::new();
    for &modality in output {
        if let Some(element) = equal_element(samples, modality) {
            notes.push(format!(
                "the setpoint is an output: its values are those of {modality}[{element}], so a model gets the answer \
                 with its action; for a recording without commands, import it with 'setpoint: none'"
            ));
            continue;
        }
        let Some(ridge) = Ridge::fit(given, &partition.training, &[modality], 0)? else { continue };
        let windows = &partition.test;
        let test = Test { samples, task: Task::Prediction, windows, since_s: &[], sampled: None };
        let rows = judge(&ridge, &test)?.metrics.into_iter().map(|row| row.row);
        let r2 = rows.filter(|row| row.metric == Metric::R2).filter_map(|row| row.value).max_by(f64::total_cmp);
        if let Some(r2) = r2.filter(|r2| *r2 > TOLD) {
            notes.push(format!(
                "the setpoint alone tells the output {modality}: ridge regression has an R2 of {r2:.3}; check that it \
                 is what was commanded, and not measured; with 'setpoint: none', models get no action"
            ));
        }
    }
    Ok(notes)
}

/// Returns the name of the first element of a vector that changes, and equals an element of the setpoint in all samples.
fn equal_element(samples: &Samples, modality: Modality) -> Option<&str> {
    let definition = &samples.layout()[modality];
    if definition.is_image() {
        return None;
    }
    let (values, width) = (samples.vectors(modality), definition.width());
    let (setpoints, commands) = (samples.setpoints(), samples.layout().action().len());
    let changes =
        |element: usize| values.iter().skip(element).step_by(width).any(|value| *value != values[element]);
    let equals = |element: usize, command: usize| {
        let pairs = values.chunks_exact(width).zip(setpoints.chunks_exact(commands));
        pairs.map(|(values, setpoints)| (values[element], setpoints[command])).all(|(one, other)| one == other)
    };
    let is_command =
        |element: &usize| changes(*element) && (0..commands).any(|command| equals(*element, command));
    (0..width).find(is_command).map(|element| definition.elements()[element].name.as_str())
}
