//! What may be wrong with a recording as the data of an experiment.

use super::ExperimentError;
use harness_judge::{Given, JudgeError, Ridge, Test, judge};
use harness_metrics::Metric;
use harness_registry::dataset::AnyDataset;
use harness_samples::{Normalizers, Partition, Sample, Samples};
use harness_shared::numbers::{counted, first_few};
use harness_spec::{
    Action, Definition, Division, Label, LabelKind, Modality, Part, Scale, Scaling, Scalings, Split, Task,
    Window,
};
use statrs::distribution::{ContinuousCDF, FisherSnedecor};
use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;

/// The R2 of a ridge regression above which the setpoint alone tells an output.
const TOLD: f64 = 0.99;

/// How far beyond the range of the training a value counts as beyond it, in parts of the range.
const BEYOND: f32 = 0.05;

/// The maximum number of trials or groups that a sentence lists. The others are only counted.
const NAMES_SHOWN: usize = 8;

/// The share of the variance between episodes that goes with a label, above which it is told, and the probability of as
/// much by chance in any element, below which it is.
const GOES_WITH: (f64, f64) = (0.5, 0.01);

/// The share of test samples beyond the range that is told.
const OFTEN: f64 = 0.05;

/// Says how runs divide a recording unless they ask for another split, and what may be wrong with it, in sentences. All
/// its vectors count as outputs.
///
/// # Errors
/// When a value is not finite.
pub fn recording_notes(samples: &Samples) -> Result<(String, Vec<String>), ExperimentError> {
    let vectors = samples.layout().stored_vectors().map(|definition| definition.name);
    let output: Vec<Modality> = vectors.filter(|name| name.is_sensed()).collect();
    let (split, window) = (samples.labels().split(&Split::default()), Window::TRANSITION);
    let told = divided(samples, &split);
    let told = told.unwrap_or_else(|| format!("runs that ask for no other split divide by {}", split.by));
    let notes = match samples.partition(&split, &window) {
        Some(partition) => notes(samples, &output, &output, &partition, &split, &window)?,
        None => vec!["this split leaves no training samples; runs must ask for another one".to_owned()],
    };
    Ok((told, notes))
}

/// Says what may be wrong with a dataset, as [`recording_notes`] does. Nothing is said of a simulated one.
///
/// # Errors
/// When a value is not finite.
pub fn dataset_notes(dataset: &AnyDataset, samples: &Samples) -> Result<Vec<String>, ExperimentError> {
    match dataset {
        AnyDataset::Imported(_) => Ok(recording_notes(samples)?.1),
        AnyDataset::Simulated(_) => Ok(Vec::new()),
    }
}

/// Says which groups are in which part of a split that keeps episodes.
fn divided(samples: &Samples, split: &Split) -> Option<String> {
    if !split.by.keeps_episodes() {
        return None;
    }
    let (labels, lengths) = (samples.labels(), lengths(samples));
    let parts = labels.parts(split, &lengths, false).ok()?;
    let values = labels.values(split.by, lengths.len()).ok()?;
    let of = |part: Part| in_part(&values, &parts, part);
    let listed = |part: Part| first_few(&of(part).into_iter().collect::<Vec<_>>(), NAMES_SHOWN);
    Some(format!(
        "runs that ask for no other split divide by {}: {} for training, {} for validation, {} for the test",
        split.by,
        of(Part::Training).len(),
        listed(Part::Validation),
        listed(Part::Test)
    ))
}

/// Returns the values of a label in one part of a split. `parts` has the part of each episode.
fn in_part<'v>(values: &'v [String], parts: &[Part], wanted: Part) -> BTreeSet<&'v str> {
    let own = values.iter().zip(parts).filter(|(_, part)| **part == wanted);
    own.map(|(value, _)| value.as_str()).collect()
}

fn lengths(samples: &Samples) -> Vec<usize> {
    samples.episodes().iter().map(Range::len).collect()
}

/// Returns what may be wrong with a recording as the data of a run, in sentences: a setpoint that tells an output, a test
/// beyond the range of the training or with other categories, groups that the training lacks, labels that training and
/// test share and that decide the values, a single trial, and episodes that are left out.
///
/// # Errors
/// When a value is not finite.
pub(super) fn notes(
    samples: &Samples,
    used: &[Modality],
    output: &[Modality],
    partition: &Partition,
    split: &Split,
    window: &Window,
) -> Result<Vec<String>, JudgeError> {
    let mut notes = setpoint_notes(samples, output, partition)?;
    notes.extend(used.iter().filter_map(|modality| beyond_range(samples, *modality, partition)));
    // The labels are those of the dataset, and not of one that the test has for itself.
    let has_own_test = samples.has_own_test();
    if !has_own_test {
        notes.extend(missing_groups(samples, split));
        notes.extend(shared_labels(samples, used, split));
    }
    let trials = samples.labels().values(Division::Label("trial"), samples.own_episodes().len());
    if !has_own_test
        && let Ok([first, others @ ..]) = trials.as_deref()
        && others.iter().all(|trial| trial == first)
    {
        notes.push(
            "all episodes are of one trial, so the test says nothing about another one; a model may know the trial by \
             its first sample"
                .to_owned(),
        );
    }
    if split.by == Division::Time {
        let rate = samples.recording().sample_rate_hz;
        let is_short = |length: &usize| split.times(*length, window.samples(), rate).is_none();
        let short: Vec<usize> = lengths(samples).into_iter().filter(is_short).collect();
        if !short.is_empty() {
            let (count, left_out) = (counted(short.len(), "episode"), counted(short.iter().sum(), "sample"));
            notes.push(format!(
                "{count} with {left_out} are left out, because they are too short for a split by time"
            ));
        }
    }
    Ok(notes)
}

/// Says how much of the test is beyond the range of the training.
fn beyond_range(samples: &Samples, modality: Modality, partition: &Partition) -> Option<String> {
    let width = samples.layout()[modality].width();
    let definition = &samples.layout()[modality];
    if definition.is_image() {
        return None;
    }
    if definition.category {
        return missing_categories(samples, definition, partition);
    }
    let mut ranges = vec![(f32::INFINITY, f32::NEG_INFINITY); width];
    for sample in &partition.training {
        for (value, (least, most)) in samples.vector(modality, *sample).iter().zip(&mut ranges) {
            (*least, *most) = (least.min(*value), most.max(*value));
        }
    }
    let margin = |(least, most): &(f32, f32)| BEYOND * (most - least);
    let is_beyond = |(value, range): (&f32, &(f32, f32))| {
        *value < range.0 - margin(range) || *value > range.1 + margin(range)
    };
    let has_beyond = |sample: &&Sample| samples.vector(modality, **sample).iter().zip(&ranges).any(is_beyond);
    let share = partition.test.iter().filter(has_beyond).count() as f64 / partition.test.len().max(1) as f64;
    (share > OFTEN).then(|| {
        format!(
            "in {:.0} % of the test samples, {modality} is beyond its range in the training, where no model has learned",
            100.0 * share
        )
    })
}

/// Says which categories are in the test only.
fn missing_categories(samples: &Samples, definition: &Definition, partition: &Partition) -> Option<String> {
    let in_part = |part: &[Sample]| {
        let mut there = vec![false; definition.width()];
        for sample in part {
            let values = samples.vector(definition.name, *sample);
            there.iter_mut().zip(values).for_each(|(there, value)| *there |= *value != 0.0);
        }
        there
    };
    let (training, test) = (in_part(&partition.training), in_part(&partition.test));
    let elements = definition.elements().iter().zip(training.iter().zip(&test));
    let missing = elements.filter(|(_, (known, tested))| !**known && **tested);
    let missing: Vec<&str> = missing.map(|(element, _)| element.name.as_str()).collect();
    (!missing.is_empty()).then(|| {
        format!(
            "the training has no {} of {}, which the test has, so no model can learn to predict it",
            first_few(&missing, NAMES_SHOWN),
            definition.name
        )
    })
}

/// Says which values of a label are in the test only. Texts count, without those that name a single episode.
fn missing_groups(samples: &Samples, split: &Split) -> Vec<String> {
    let (labels, lengths) = (samples.labels(), lengths(samples));
    let Ok(parts) = labels.parts(split, &lengths, false) else { return Vec::new() };
    if !split.by.keeps_episodes() {
        return Vec::new();
    }
    let texts = samples.layout().labels.iter().filter(|label| label.kind == LabelKind::Text);
    let sentence = |label: &Label| {
        let by = Division::new(&label.name).filter(|by| *by != split.by)?;
        let values = labels.values(by, lengths.len()).ok()?;
        let all: BTreeSet<&String> = values.iter().collect();
        let [training, test] = [Part::Training, Part::Test].map(|part| in_part(&values, &parts, part));
        let missing: Vec<&str> = test.difference(&training).copied().collect();
        (all.len() < values.len() && !missing.is_empty()).then(|| {
            format!(
                "the training has no {} {}, which the test has",
                label.name,
                first_few(&missing, NAMES_SHOWN)
            )
        })
    };
    texts.filter_map(sentence).collect()
}

/// Says which labels decide most of what differs between episodes, such as the day of the recording, and have values that
/// training and test share. A model may use that, and the test does not show what happens with another value.
fn shared_labels(samples: &Samples, used: &[Modality], split: &Split) -> Vec<String> {
    let (labels, lengths) = (samples.labels(), lengths(samples));
    // A category follows from a label by itself.
    let is_measured = |modality: &Modality| {
        let definition = &samples.layout()[*modality];
        !definition.is_image() && !definition.category
    };
    let vectors: Vec<Modality> = used.iter().copied().filter(is_measured).collect();
    let means: Vec<(Modality, Vec<Vec<f64>>)> =
        vectors.into_iter().map(|modality| (modality, episode_means(samples, modality))).collect();
    let elements: usize = means.iter().map(|(_, elements)| elements.len()).sum();
    let sentence = |label: &Label| {
        let by = Division::new(&label.name).filter(|by| *by != split.by && label.kind != LabelKind::Real)?;
        let values = labels.values(by, lengths.len()).ok()?;
        if !is_shared(&values, samples, split) {
            return None;
        }
        let of_elements =
            means.iter().flat_map(|(modality, elements)| elements.iter().map(move |means| (modality, means)));
        let explained =
            of_elements.filter_map(|(modality, means)| Some((modality, explained(means, &values)?)));
        let (modality, (share, p)) = explained.max_by(|(_, (a, _)), (_, (b, _))| a.total_cmp(b))?;
        (share > GOES_WITH.0 && p * elements as f64 <= GOES_WITH.1).then(|| {
            format!(
                "{:.0} % of the variance of {modality} between episodes goes with the label {by}, whose values are in \
                 training and test alike; with split: {{by: {by}}}, the test has values that the training lacks",
                100.0 * share
            )
        })
    };
    samples.layout().labels.iter().filter_map(sentence).collect()
}

/// Whether a value of a label is in the training and in the test.
fn is_shared(values: &[String], samples: &Samples, split: &Split) -> bool {
    if !split.by.keeps_episodes() {
        return true;
    }
    let Ok(parts) = samples.labels().parts(split, &lengths(samples), false) else { return false };
    !in_part(values, &parts, Part::Training).is_disjoint(&in_part(values, &parts, Part::Test))
}

/// The mean of each element of a vector in each episode, `[element][episode]`.
fn episode_means(samples: &Samples, modality: Modality) -> Vec<Vec<f64>> {
    let width = samples.layout()[modality].width();
    let values = samples.vectors(modality);
    let mean = |element: usize, range: &Range<usize>| {
        let own = values[range.start * width..range.end * width].iter().skip(element).step_by(width);
        own.map(|value| f64::from(*value)).sum::<f64>() / range.len() as f64
    };
    let of_element = |element| samples.own_episodes().iter().map(|range| mean(element, range)).collect();
    (0..width).map(of_element).collect()
}

/// The share of the variance of `means` that goes with a label, without what chance adds (ω², Hays 1963), and the p-value
/// of the F-test of a one-way analysis of variance. `None` if each value is of one episode, or there is a single value.
fn explained(means: &[f64], values: &[String]) -> Option<(f64, f64)> {
    let mut groups: BTreeMap<&String, Vec<f64>> = BTreeMap::new();
    values.iter().zip(means).for_each(|(value, mean)| groups.entry(value).or_default().push(*mean));
    let mean_of = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
    let around =
        |values: &[f64], center: f64| values.iter().map(|value| (value - center).powi(2)).sum::<f64>();
    let total = around(means, mean_of(means));
    let within: f64 = groups.values().map(|group| around(group, mean_of(group))).sum();
    let (between, left) = ((groups.len() - 1) as f64, means.len().checked_sub(groups.len())? as f64);
    if between == 0.0 || left == 0.0 || total == 0.0 {
        return None;
    }
    let noise = within / left;
    let share = (total - within - between * noise) / (total + noise);
    let p = match noise > 0.0 {
        true => FisherSnedecor::new(between, left).ok()?.sf((total - within) / between / noise),
        false => 0.0,
    };
    Some((share, p))
}

/// Returns a sentence for each output of a recording that its setpoint contains or tells, because a model reads it off
/// its action then. The regression is fitted to the training samples and judged on those of the test.
///
/// # Errors
/// When a value is not finite.
fn setpoint_notes(
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
    let given =
        Given { samples, sensed: samples, normalizers: &normalizers, action, input: &[Modality::SETPOINT] };
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
        let r2 =
            rows.filter(|row| row.metric == Metric::R2).filter_map(|row| row.value).max_by(f64::total_cmp);
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
        pairs
            .map(|(values, setpoints)| (values[element], setpoints[command]))
            .all(|(one, other)| one == other)
    };
    let is_command =
        |element: &usize| changes(*element) && (0..commands).any(|command| equals(*element, command));
    (0..width).find(is_command).map(|element| definition.elements()[element].name.as_str())
}
