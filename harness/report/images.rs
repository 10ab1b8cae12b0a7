//! Puts predicted images beside the references, for a few test samples.

use super::subjects::{Subject, of_each};
use super::{Absent, Asked};
use base64::Engine;
use base64::engine::general_purpose::STANDARD as BASE64;
use harness_catalog::rows;
use harness_figures::FigureError;
use harness_figures::source::{Runs, Source};
use harness_spec::{CLASS_COLORS, Definition, IMAGE_CHANNELS, Modality, Origin, Task};
use image::imageops::{FilterType, resize};
use image::{ImageFormat, RgbImage};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::io::Cursor;

/// Longest side of a picture in the page, pixels. Larger images are made smaller.
const SIDE: u32 = 128;

/// The images of a modality in a scenario: the references, and the predictions of each latent size.
#[derive(Serialize)]
pub struct Images {
    /// Whose networks they are, in words; empty if the page has only one subject.
    subject: String,
    scenario: String,
    task: Task,
    modality: String,
    /// Whether they are changes, in which gray means no change.
    is_change: bool,
    /// What their colors encode; empty if they are those that a camera sees.
    code: String,
    width: u32,
    height: u32,
    /// The episode and the number of each sample.
    samples: Vec<(u32, u32)>,
    rows: Vec<Row>,
}

/// A row of pictures.
#[derive(Serialize)]
struct Row {
    name: String,
    /// PNG files in base64; `None` if a network has no prediction of the sample.
    pictures: Vec<Option<String>>,
}

/// A row of the frames table, without its pictures.
#[derive(Deserialize)]
struct Of {
    task: Task,
    modality: Modality,
    scenario: Origin,
    latent: Option<u64>,
    episode: u32,
    sample: u32,
}

/// Returns the images of all subjects, and a reason for each subject without runs. Experiments that predict no images
/// have none, which needs no reason.
///
/// # Errors
/// When a table can't be read, or a picture can't be encoded.
pub fn images(
    source: &Source,
    subjects: &[Subject],
    asked: &Asked,
) -> Result<(Vec<Images>, BTreeSet<Absent>), FigureError> {
    let is_alone = subjects.len() < 2;
    of_each(source, subjects, asked, |runs, subject| match of_subject(runs, subject, is_alone) {
        Err(error) if error.has_nothing_to_draw() => Ok(Vec::new()),
        outcome => outcome,
    })
}

/// The episode and the number of a sample, and its pictures.
type Sample = ((u32, u32), Pictures);

/// The pictures of a sample: its reference, and the predictions by latent size.
type Pictures = (String, BTreeMap<Option<u64>, String>);

fn of_subject(runs: &Runs, subject: &Subject, is_alone: bool) -> Result<Vec<Images>, FigureError> {
    let answer = runs.query_first_seeds(
        "select task, modality, scenario, latent, episode, sample, reference, predicted from frames \
         order by motion, episode, sample, latent",
    )?;
    let column = |name: &str| -> Result<Vec<Vec<u8>>, FigureError> {
        let bytes = answer.column(name)?.binary()?;
        Ok(bytes.iter().map(|bytes| bytes.unwrap_or_default().to_vec()).collect())
    };
    let (references, predicted) = (column("reference")?, column("predicted")?);
    let mut keys = answer.select(["task", "modality", "scenario", "latent", "episode", "sample"])?;
    let mut found: BTreeMap<(Origin, Task, Modality), Vec<Sample>> = BTreeMap::new();
    for (row, of) in rows::<Of>(&mut keys)?.into_iter().enumerate() {
        let size = size(runs, &of).unwrap_or_default();
        let Some(prediction) = png(&predicted[row], size)? else { continue };
        let samples = found.entry((of.scenario, of.task, of.modality)).or_default();
        let place = match samples.iter().position(|(sample, _)| *sample == (of.episode, of.sample)) {
            Some(place) => place,
            None => {
                let Some(reference) = png(&references[row], size)? else { continue };
                samples.push(((of.episode, of.sample), (reference, BTreeMap::new())));
                samples.len() - 1
            }
        };
        samples[place].1.1.insert(of.latent, prediction);
    }
    let images = |((scenario, task, modality), samples): ((Origin, Task, Modality), Vec<_>)| {
        let of = Of { task, modality, scenario, latent: None, episode: 0, sample: 0 };
        let [height, width] = size(runs, &of)?;
        let definition = runs.all.iter().find_map(|run| run.record.layout.get(modality))?;
        Some(Images {
            subject: if is_alone { String::new() } else { subject.words.clone() },
            scenario: of.scenario.to_string(),
            task,
            modality: modality.name().replace('_', " "),
            is_change: definition.difference_of.is_some(),
            code: code(definition),
            width,
            height,
            samples: samples.iter().map(|(sample, _)| *sample).collect(),
            rows: table(samples),
        })
    };
    Ok(found.into_iter().filter_map(images).collect())
}

/// What the colors of an image encode, in words.
fn code(definition: &Definition) -> String {
    if definition.optical_flow {
        return "optical flow in red (right) and green (down)".into();
    }
    if let Some([low, high]) = definition.depth_range_m {
        return format!("depth from {low} to {high} m in red, and near depths in green");
    }
    let classes = definition.segmentation.iter().flat_map(|segmentation| &segmentation.classes);
    let classes: Vec<String> =
        CLASS_COLORS.iter().zip(classes).map(|((color, _), class)| format!("{class} in {color}")).collect();
    classes.join(", ")
}

/// The rows of pictures of these samples: the references first, then the predictions by latent size.
fn table(samples: Vec<Sample>) -> Vec<Row> {
    let latents: BTreeSet<Option<u64>> = samples.iter().flat_map(|(_, (_, of))| of.keys().copied()).collect();
    let references = samples.iter().map(|(_, (reference, _))| Some(reference.clone()));
    let references = Row { name: "reference".into(), pictures: references.collect() };
    let predictions = latents.into_iter().map(|latent| Row {
        name: latent.map_or_else(|| "predicted".into(), |latent| format!("z = {latent}")),
        pictures: samples.iter().map(|(_, (_, predicted))| predicted.get(&latent).cloned()).collect(),
    });
    std::iter::once(references).chain(predictions).collect()
}

/// Rows and columns of the images of a modality in a scenario, pixels.
fn size(runs: &Runs, of: &Of) -> Option<[u32; 2]> {
    let mut of_scenario = runs.all.iter().filter(|run| run.record.spec.scenario == of.scenario);
    let size = of_scenario.find_map(|run| run.record.layout.get(of.modality)?.size())?;
    Some(size.map(|pixels| pixels as u32))
}

/// Encodes an image as a PNG file in base64. `None` if it has another size.
fn png(bytes: &[u8], [rows, columns]: [u32; 2]) -> Result<Option<String>, FigureError> {
    if bytes.is_empty() || bytes.len() != rows as usize * columns as usize * IMAGE_CHANNELS {
        return Ok(None);
    }
    let Some(picture) = RgbImage::from_raw(columns, rows, bytes.to_vec()) else { return Ok(None) };
    let longest = rows.max(columns);
    let picture = match longest > SIDE {
        true => {
            let shrunk = |side: u32| (side * SIDE / longest).max(1);
            resize(&picture, shrunk(columns), shrunk(rows), FilterType::Triangle)
        }
        false => picture,
    };
    let mut file = Cursor::new(Vec::new());
    picture.write_to(&mut file, ImageFormat::Png).map_err(|error| FigureError::Picture(error.to_string()))?;
    Ok(Some(BASE64.encode(file.into_inner())))
}
