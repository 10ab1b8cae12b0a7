//! The page of a dataset: what was recorded, before any training.

use super::{ReportError, STYLE, rendered, style_policy};
use base64::Engine;
use base64::engine::general_purpose::STANDARD as BASE64;
use harness_registry::dataset::{AnyDataset, ImportReport};
use harness_samples::{Sample, Samples};
use harness_shared::numbers::rounded;
use harness_spec::{Definition, IMAGE_CHANNELS, Modality, Split, Window};
use image::imageops::{FilterType, resize};
use image::{ImageFormat, RgbImage};
use serde::Serialize;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;
use std::io::Cursor;
use std::ops::Range;

const TEMPLATE: &str = include_str!("dataset.html");
/// Largest number of episodes that are drawn. They are evenly chosen.
const EPISODES: usize = 4;
/// Largest number of elements of a modality that are drawn. They are evenly chosen.
const LINES: usize = 6;
/// Largest number of points of a line, of which each is the least and the greatest value of some samples.
const POINTS: usize = 160;
/// Width and height of a drawing, in its own units.
const SIZE: [f64; 2] = [320.0, 90.0];
/// Largest number of pictures in a row, and the longest side of one, pixels.
const PICTURES: (usize, u32) = (6, 128);
/// Largest number of samples from which correlations are computed. They are taken at equal distances.
const CORRELATED: usize = 10_000;
/// The longest lag between two modalities, s.
const LONGEST_LAG: f64 = 1.0;
/// Largest number of lags in each direction.
const LAGS: usize = 50;

/// The names of the parts of a split.
const PARTS: [&str; 3] = ["training", "validation", "test"];

/// The values that the template uses.
#[derive(Serialize)]
struct Page {
    style: &'static str,
    policy: String,
    name: String,
    facts: Vec<(&'static str, String)>,
    /// What may make a result misleading.
    remarks: Vec<String>,
    /// What an import left out or changed.
    cleaned: Vec<String>,
    /// The times of an import's streams, as a table with its head.
    streams: Vec<Vec<String>>,
    parts: Vec<OfPart>,
    labels: Vec<Label>,
    modalities: Vec<OfModality>,
    relations: Vec<Relation>,
    images: Vec<Images>,
}

/// A part of the split.
#[derive(Serialize)]
struct OfPart {
    name: &'static str,
    samples: usize,
    episodes: usize,
}

/// The values of a label, with the number of episodes in each part.
#[derive(Serialize)]
struct Label {
    name: String,
    values: Vec<(String, [usize; 3])>,
}

/// What was recorded of a vector.
#[derive(Serialize)]
struct OfModality {
    name: String,
    unit: String,
    /// Where an import has it from.
    source: Option<String>,
    /// The names of the elements that are drawn.
    drawn: Vec<String>,
    courses: Vec<Course>,
    elements: Vec<OfElement>,
}

/// The values of a modality along an episode.
#[derive(Serialize)]
struct Course {
    title: String,
    /// An SVG path for each drawn element.
    lines: Vec<String>,
    /// The greatest and the least value of the modality in all drawn episodes.
    ends: [String; 2],
}

/// The distribution of an element.
#[derive(Serialize)]
struct OfElement {
    name: String,
    unit: String,
    /// Mean, standard deviation, least and greatest value in each part; `None` for a part without samples.
    parts: [Option<[String; 4]>; 3],
    /// The share of test samples outside of the range of the training samples, %.
    outside: String,
}

/// How two modalities go together.
#[derive(Serialize)]
struct Relation {
    elements: [String; 2],
    /// Pearson's correlation at the same sample.
    now: String,
    /// The lag at which the correlation is strongest, and that correlation. A positive lag means that the second element
    /// follows the first.
    lag_s: String,
    then: String,
}

/// Images along an episode.
#[derive(Serialize)]
struct Images {
    name: String,
    /// Where an import has them from.
    source: Option<String>,
    episode: usize,
    width: u32,
    height: u32,
    /// The time of each, s, and its PNG file in base64.
    pictures: Vec<(String, String)>,
}

/// Makes the page of a dataset and returns it as an HTML document. Parts are those of the dataset's own split. The notes
/// are what may make a result misleading, in sentences.
///
/// # Errors
/// When an episode is missing or damaged, or a picture can't be encoded.
pub fn dataset_page(
    dataset: &AnyDataset,
    samples: &Samples,
    notes: Vec<String>,
) -> Result<String, ReportError> {
    let split = samples.split(&Split::default());
    let parts = parts(samples, &split);
    let import = match dataset {
        AnyDataset::Imported(imported) => imported.report().clone(),
        AnyDataset::Simulated(_) => ImportReport::default(),
    };
    let vectors: Vec<&Definition> =
        samples.layout().modalities.iter().filter(|definition| !definition.is_image()).collect();
    let modalities: Vec<OfModality> =
        vectors.iter().map(|definition| of_modality(samples, definition, &parts, &import)).collect();
    let page = Page {
        style: &STYLE,
        policy: style_policy(),
        name: dataset.name().to_owned(),
        facts: facts(dataset, samples, &split),
        remarks: remarks(&modalities, &parts).into_iter().chain(notes).collect(),
        labels: labels(samples, &parts),
        relations: relations(samples, &vectors, &parts[0]),
        images: images(dataset, &import)?,
        parts: PARTS.into_iter().zip(&parts).map(|(name, at)| of_part(name, samples, at)).collect(),
        modalities,
        streams: import.streams,
        cleaned: import.cleaned,
    };
    Ok(rendered("dataset.html", TEMPLATE, &page)?)
}

/// The samples of training, validation and test. Without enough samples for all of them, all are for training.
fn parts(samples: &Samples, split: &Split) -> [Vec<Sample>; 3] {
    let own = Window { horizon: 0, ..Window::TRANSITION };
    match samples.partition(split, &own) {
        Some(partition) => [partition.training, partition.validation, partition.test],
        None => [(0..samples.len()).map(Sample::at).collect(), Vec::new(), Vec::new()],
    }
}

fn of_part(name: &'static str, samples: &Samples, at: &[Sample]) -> OfPart {
    let of: BTreeSet<usize> = at.iter().map(|sample| samples.place(*sample).0).collect();
    OfPart { name, samples: at.len(), episodes: of.len() }
}

fn facts(dataset: &AnyDataset, samples: &Samples, split: &Split) -> Vec<(&'static str, String)> {
    let rate = dataset.sample_rate_hz();
    let lengths = samples.episodes().iter().map(|range| range.len() as f64 / rate);
    let (shortest, longest) =
        lengths.fold((f64::INFINITY, 0.0_f64), |(low, high), one| (low.min(one), high.max(one)));
    let of = match shortest == longest {
        true => rounded(longest),
        false => format!("{} to {}", rounded(shortest), rounded(longest)),
    };
    vec![
        (
            "made by",
            if matches!(dataset, AnyDataset::Imported(_)) { "an import" } else { "a simulation" }.into(),
        ),
        ("episodes", format!("{}, of {of} s", samples.episodes().len())),
        ("samples", format!("{} at {} Hz", samples.len(), rounded(rate))),
        ("length", format!("{} s", rounded(samples.len() as f64 / rate))),
        ("split by", split.by.name().to_owned()),
    ]
}

/// What may make a result misleading: elements that do not change, and too little data.
fn remarks(modalities: &[OfModality], parts: &[Vec<Sample>; 3]) -> Vec<String> {
    let mut found = Vec::new();
    if parts[2].is_empty() {
        found.push("too little data for a training, a validation and a test part by this split".to_owned());
    }
    for modality in modalities {
        let constant = |one: &&OfElement| one.parts[0].as_ref().is_some_and(|[_, _, low, high]| low == high);
        let names: Vec<&str> =
            modality.elements.iter().filter(constant).map(|one| one.name.as_str()).collect();
        if !names.is_empty() {
            found.push(format!(
                "{} the same in all training samples: {}",
                if names.len() == 1 { "an element is" } else { "some elements are" },
                names.iter().map(|name| format!("{}[{name}]", modality.name)).collect::<Vec<_>>().join(", ")
            ));
        }
    }
    found
}

fn labels(samples: &Samples, parts: &[Vec<Sample>; 3]) -> Vec<Label> {
    let mut part_of: BTreeMap<usize, usize> = BTreeMap::new();
    for (part, at) in parts.iter().enumerate() {
        part_of.extend(at.iter().map(|sample| (samples.place(*sample).0, part)));
    }
    let mut labels: BTreeMap<&str, BTreeMap<&str, [usize; 3]>> = BTreeMap::new();
    for (episode, of) in samples.labels().episodes.iter().enumerate() {
        let Some(part) = part_of.get(&episode) else { continue };
        for (name, value) in of {
            labels.entry(name).or_default().entry(value.as_deref().unwrap_or("-")).or_default()[*part] += 1;
        }
    }
    // A label that differs in every episode, such as the name of the file, divides nothing.
    labels.retain(|_, values| values.len() > 1 && values.values().flatten().any(|count| *count > 1));
    let label = |(name, values): (&str, BTreeMap<&str, [usize; 3]>)| Label {
        name: name.to_owned(),
        values: values.into_iter().map(|(value, counts)| (value.to_owned(), counts)).collect(),
    };
    labels.into_iter().map(label).collect()
}

/// Returns so many numbers below `count`, evenly spread.
fn evenly(count: usize, most: usize) -> Vec<usize> {
    (0..most.min(count)).map(|index| index * count / most.min(count)).collect()
}

fn of_modality(
    samples: &Samples,
    definition: &Definition,
    parts: &[Vec<Sample>; 3],
    import: &ImportReport,
) -> OfModality {
    let elements = definition.elements();
    let chosen = evenly(elements.len(), LINES);
    let episodes: Vec<(usize, &Range<usize>)> = evenly(samples.episodes().len(), EPISODES)
        .into_iter()
        .map(|index| (index, &samples.episodes()[index]))
        .collect();
    let value = |sample: usize, element: usize| {
        f64::from(samples.vector(definition.name, Sample::at(sample))[element])
    };
    let all = episodes.iter().flat_map(|(_, range)| (*range).clone());
    let drawn = all.flat_map(|sample| chosen.iter().map(move |element| value(sample, *element)));
    let (low, high) =
        drawn.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), one| (low.min(one), high.max(one)));
    let course = |(episode, range): (usize, &Range<usize>)| Course {
        title: titled(samples, episode, range),
        lines: chosen
            .iter()
            .map(|element| line(range, [low, high], |sample| value(sample, *element)))
            .collect(),
        ends: [rounded(high), rounded(low)],
    };
    let units: BTreeSet<&str> = chosen
        .iter()
        .map(|element| elements[*element].unit.as_str())
        .filter(|unit| !["", "1"].contains(unit))
        .collect();
    OfModality {
        name: definition.name.to_string(),
        source: import.sources.get(definition.name.name()).cloned(),
        unit: units.into_iter().collect::<Vec<_>>().join(", "),
        drawn: chosen.iter().map(|element| elements[*element].name.clone()).collect(),
        courses: episodes.into_iter().map(course).collect(),
        elements: (0..elements.len())
            .map(|element| of_element(samples, definition, element, parts))
            .collect(),
    }
}

/// The name of an episode, with its labels.
fn titled(samples: &Samples, episode: usize, range: &Range<usize>) -> String {
    let labels = samples.labels().episodes.get(episode).into_iter().flatten();
    let labels: Vec<String> =
        labels.filter_map(|(name, value)| Some(format!("{name} {}", value.as_ref()?))).collect();
    let seconds = rounded(range.len() as f64 / samples.recording().sample_rate_hz);
    [vec![format!("episode {episode}, {seconds} s")], labels].concat().join(", ")
}

/// The path of a line through the least and the greatest of every few samples, so that no spike is lost.
fn line(range: &Range<usize>, [low, high]: [f64; 2], value: impl Fn(usize) -> f64) -> String {
    let [width, height] = SIZE;
    let step = range.len().div_ceil(POINTS).max(1);
    let across = |sample: usize| width * (sample - range.start) as f64 / (range.len().max(2) - 1) as f64;
    let up = |value: f64| if high > low { height * (high - value) / (high - low) } else { height / 2.0 };
    let mut path = String::new();
    for first in range.clone().step_by(step) {
        let of = first..(first + step).min(range.end);
        let order = |one: &usize, other: &usize| value(*one).total_cmp(&value(*other));
        let (least, greatest) =
            (of.clone().min_by(order).unwrap_or(first), of.max_by(order).unwrap_or(first));
        let mut ends = [least, greatest];
        ends.sort_unstable();
        for sample in &ends[..if least == greatest { 1 } else { 2 }] {
            let command = if path.is_empty() { 'M' } else { 'L' };
            let _ = write!(path, "{command}{:.1} {:.1}", across(*sample), up(value(*sample)));
        }
    }
    path
}

fn of_element(
    samples: &Samples,
    definition: &Definition,
    element: usize,
    parts: &[Vec<Sample>; 3],
) -> OfElement {
    let values = |at: &[Sample]| -> Vec<f64> {
        at.iter().map(|sample| f64::from(samples.vector(definition.name, *sample)[element])).collect()
    };
    let all = parts.each_ref().map(|at| values(at));
    let described = all.each_ref().map(|values| described(values));
    let outside = described[0].zip(described[2]).map(|([_, _, low, high], _)| {
        let is_outside = |value: &&f64| **value < low || **value > high;
        100.0 * all[2].iter().filter(is_outside).count() as f64 / all[2].len() as f64
    });
    OfElement {
        name: definition.elements()[element].name.clone(),
        unit: definition.elements()[element].unit.clone(),
        parts: described.map(|part| part.map(|numbers| numbers.map(rounded))),
        outside: outside.map_or_else(|| "-".to_owned(), |share| format!("{share:.1}")),
    }
}

/// Mean, standard deviation, least and greatest value; `None` without values.
fn described(values: &[f64]) -> Option<[f64; 4]> {
    let count = values.len() as f64;
    let mean = values.iter().sum::<f64>() / count;
    let variance = values.iter().map(|value| (value - mean) * (value - mean)).sum::<f64>() / count;
    let least = values.iter().copied().reduce(f64::min)?;
    Some([mean, variance.sqrt(), least, values.iter().copied().reduce(f64::max)?])
}

/// For each two vectors, the elements that correlate most in the training samples, and the lag at which they do.
fn relations(samples: &Samples, vectors: &[&Definition], training: &[Sample]) -> Vec<Relation> {
    let step = training.len().div_ceil(CORRELATED).max(1);
    let at: Vec<Sample> = training.iter().copied().step_by(step).collect();
    let mut found = Vec::new();
    for (index, one) in vectors.iter().enumerate() {
        for other in &vectors[index + 1..] {
            let strongest = pairs(one, other)
                .filter_map(|pair| Some((pair, correlation(samples, [one.name, other.name], pair, &at, 0)?)))
                .max_by(|(_, a), (_, b)| a.abs().total_cmp(&b.abs()));
            if let Some((pair, now)) = strongest {
                found.push((now, relation(samples, [one, other], pair, &at, now)));
            }
        }
    }
    found.sort_by(|(a, _), (b, _)| b.abs().total_cmp(&a.abs()));
    found.into_iter().map(|(_, relation)| relation).collect()
}

/// Some elements of two modalities, each with each.
fn pairs(one: &Definition, other: &Definition) -> impl Iterator<Item = [usize; 2]> + use<> {
    let others = evenly(other.width(), 2 * LINES);
    evenly(one.width(), 2 * LINES)
        .into_iter()
        .flat_map(move |a| others.clone().into_iter().map(move |b| [a, b]))
}

fn relation(
    samples: &Samples,
    both: [&Definition; 2],
    pair: [usize; 2],
    at: &[Sample],
    now: f64,
) -> Relation {
    let rate = samples.recording().sample_rate_hz;
    let most = ((LONGEST_LAG * rate).floor() as isize).min(LAGS as isize);
    let names = [both[0].name, both[1].name];
    let (lag, then) = (-most..=most)
        .filter_map(|lag| Some((lag, correlation(samples, names, pair, at, lag)?)))
        .fold((0, now), |best, one| if one.1.abs() > best.1.abs() { one } else { best });
    let element = |which: usize| match both[which].elements() {
        [_] => names[which].to_string(),
        elements => format!("{}[{}]", names[which], elements[pair[which]].name),
    };
    Relation {
        elements: [element(0), element(1)],
        now: format!("{now:.2}"),
        lag_s: rounded(lag as f64 / rate),
        then: format!("{then:.2}"),
    }
}

/// Pearson's correlation of an element at the samples `at` with another one `lag` samples later in the same episode.
/// `None` if one of them is constant, or there are fewer than three such samples.
fn correlation(
    samples: &Samples,
    [one, other]: [Modality; 2],
    [a, b]: [usize; 2],
    at: &[Sample],
    lag: isize,
) -> Option<f64> {
    let values = at.iter().filter_map(|sample| {
        let range = &samples.episodes()[samples.place(*sample).0];
        let later = sample.index().checked_add_signed(lag).filter(|later| range.contains(later))?;
        let value =
            |modality: Modality, at: Sample, element: usize| f64::from(samples.vector(modality, at)[element]);
        Some([value(one, *sample, a), value(other, Sample::at(later), b)])
    });
    let values: Vec<[f64; 2]> = values.collect();
    let of = |which: usize| values.iter().map(|pair| pair[which]).collect::<Vec<f64>>();
    let ([mean_a, deviation_a, low_a, high_a], [mean_b, deviation_b, low_b, high_b]) =
        (described(&of(0))?, described(&of(1))?);
    if values.len() < 3 || low_a == high_a || low_b == high_b {
        return None;
    }
    let product: f64 = values.iter().map(|[a, b]| (a - mean_a) * (b - mean_b)).sum();
    Some(product / values.len() as f64 / (deviation_a * deviation_b))
}

/// Some images of an episode in the middle of the dataset.
fn images(dataset: &AnyDataset, import: &ImportReport) -> Result<Vec<Images>, ReportError> {
    let layout = dataset.layout().clone();
    let stored: Vec<&Definition> =
        layout.modalities.iter().filter(|one| one.is_image() && one.difference_of.is_none()).collect();
    let episode = dataset.episodes() / 2;
    if stored.is_empty() || dataset.episodes() == 0 {
        return Ok(Vec::new());
    }
    let samples = dataset.load_episode(episode)?;
    let strip = |definition: &Definition| {
        let source = import.sources.get(definition.name.name()).cloned();
        Ok(Images { source, ..strip(&samples, definition, episode as usize)? })
    };
    stored.into_iter().map(strip).collect()
}

fn strip(samples: &Samples, definition: &Definition, episode: usize) -> Result<Images, ReportError> {
    let (most, side) = PICTURES;
    let [rows, columns] = definition.size().unwrap_or_default().map(|side| side as u32);
    let shrink = f64::from(side) / f64::from(rows.max(columns).max(side));
    let [height, width] = [rows, columns].map(|side| ((f64::from(side) * shrink).round() as u32).max(1));
    let rate = samples.recording().sample_rate_hz;
    let picture = |sample: usize| {
        let planes = samples.frame_bytes(definition.name, Sample::at(sample));
        let area = (rows * columns) as usize;
        let pixels =
            (0..area).flat_map(|at| (0..IMAGE_CHANNELS).map(move |channel| planes[channel * area + at]));
        let whole = RgbImage::from_raw(columns, rows, pixels.collect()).unwrap_or_default();
        let mut png = Cursor::new(Vec::new());
        resize(&whole, width, height, FilterType::Triangle).write_to(&mut png, ImageFormat::Png)?;
        Ok::<_, image::ImageError>((rounded(sample as f64 / rate), BASE64.encode(png.into_inner())))
    };
    let pictures = evenly(samples.len(), most).into_iter().map(picture).collect::<Result<_, _>>()?;
    Ok(Images { name: definition.name.to_string(), source: None, episode, width, height, pictures })
}
