//! Figure of the predicted change of the camera's picture beside the reference, in each scenario. For any robot, it
//! shows the first change of an image that is predicted.

use super::axes::{mean_words, remarks};
use super::page::{COLUMN, GRAY, Page, Stroke, Type};
use super::source::{Runs, Source, Study, integers, reals, replicated};
use super::{Drawing, FigureError};
use harness_analysis::{Interval, intervals};
use harness_spec::{IMAGE_CHANNELS, Modality};
use image::{Rgb, RgbImage};
use polars::prelude::*;
use std::collections::{BTreeMap, BTreeSet};

const LEFT: f64 = 58.0;
const GAP: f64 = 3.0;
const TOP: f64 = 14.0;

/// Smallest height of a row, which has two lines of text at its left.
const LEAST_ROW: f64 = 16.0;

/// Number of trials shown per scenario: the ones with the most motion among those in the runs' tables.
const TRIALS: usize = 3;

/// The change that has the strongest colors. It is smaller than 1, so that faint predictions are visible beside the
/// reference.
const RANGE: f32 = 0.3;

/// Colors of changes from -1 to 1 times [`RANGE`]: ColorBrewer's RdBu, which color-blind people can read.
const COLORS: [[f64; 3]; 7] = [
    [33.0, 102.0, 172.0],
    [103.0, 169.0, 207.0],
    [209.0, 229.0, 240.0],
    [247.0, 247.0, 247.0],
    [253.0, 219.0, 199.0],
    [239.0, 138.0, 98.0],
    [178.0, 24.0, 43.0],
];

/// A transition of the test set: a sample and the one before it.
struct Trial {
    episode: i64,
    /// The predicted sample's number in its episode.
    sample: i64,
    motion: f64,
    /// The camera's picture at the sample before, RGB. Only runs that reconstruct vision have it.
    camera: Option<Vec<u8>>,
    /// The change of each pixel, row by row: the mean over the three colors, in [-1, 1].
    reference: Vec<f32>,
    /// The predicted changes in the same form, by latent size.
    predicted: BTreeMap<i64, Vec<f32>>,
}

/// The part of the figure that shows one scenario.
struct Block {
    scenario: String,
    /// Numbers of rows and columns of the camera's pictures, pixels.
    size: [usize; 2],
    trials: Vec<Trial>,
    /// Errors by latent size.
    errors: BTreeMap<i64, RelativeError>,
}

/// The squared error of the predicted change relative to that of predicting no change.
struct RelativeError {
    /// The mean over all networks.
    mean: Interval,
    /// The error of the network whose predictions are shown.
    shown: Option<f64>,
}

/// Draws the figure.
pub fn render(source: &Source) -> Result<Drawing, FigureError> {
    draw(&source.runs(Study::MultiToMulti)?, Modality::FRAME_DIFFERENCE, Modality::VISION)
}

/// Draws the first change of an image that any robot's networks predict.
///
/// # Errors
/// When the runs predict no change of an image, or a table can't be read.
pub fn render_of(runs: &Runs) -> Result<Drawing, FigureError> {
    let mut outputs = runs.all[0].record.spec.output.iter().filter_map(|output| runs.layout().get(*output));
    let change =
        outputs.find_map(|output| Some((output.name, output.difference_of.filter(|_| output.is_image())?)));
    let (change, camera) = change.ok_or_else(|| runs.no_rows())?;
    draw(runs, change, camera)
}

/// Draws the change `image` of a camera's picture.
fn draw(runs: &Runs, image: Modality, camera: Modality) -> Result<Drawing, FigureError> {
    let blocks = blocks(runs, image, camera)?;
    let width = blocks.iter().map(Block::width).fold(f64::INFINITY, f64::min);
    let height: f64 = blocks.iter().map(|block| block.height(width)).sum();
    let mut page = Page::new(COLUMN, height + 77.0, "Predicted change of the camera's picture");
    let mut top = 0.0;
    for block in &blocks {
        block.render(&mut page, top, width)?;
        top += block.height(width);
    }
    color_bar(&mut page, top + 5.0)?;
    let lines = [
        "error: squared, of all test samples, relative to predicting no change;",
        "mean ± 95 % over all networks; shown: the network of the lowest seed",
        "on the first dataset, whatever its error",
        "motion: mean absolute change of the image, of white minus black;",
        "samples: the three kept test samples with the most of it",
    ];
    remarks(&mut page, top + 38.0, lines);
    Ok(Drawing { page, data: data(&blocks, runs.experiment.as_str())? })
}

impl Block {
    /// The latent sizes that have a prediction of at least one of the trials, ascending.
    fn latents(&self) -> BTreeSet<i64> {
        self.trials.iter().flat_map(|trial| trial.predicted.keys().copied()).collect()
    }

    /// Whether each of the trials has the camera's picture before the change.
    fn has_camera(&self) -> bool {
        self.trials.iter().all(|trial| trial.camera.is_some())
    }

    /// The width of the block's pictures if they fill the page's width, points.
    fn width(&self) -> f64 {
        let columns = self.trials.len() as f64;
        (COLUMN - LEFT - 3.0 - GAP * (columns - 1.0)) / columns
    }

    /// Width and height of a picture of this width, points.
    fn picture(&self, width: f64) -> [f64; 2] {
        let [rows, columns] = self.size.map(|pixels| pixels as f64);
        [width, width * rows / columns]
    }

    /// Height of a row of pictures of this width, with the gap below, points.
    fn row(&self, width: f64) -> f64 {
        self.picture(width)[1].max(LEAST_ROW) + GAP
    }

    /// Height of the block, points.
    fn height(&self, width: f64) -> f64 {
        let rows = self.latents().len() + 1 + usize::from(self.has_camera());
        TOP + rows as f64 * self.row(width) + GAP
    }

    fn render(&self, page: &mut Page, top: f64, width: f64) -> Result<(), FigureError> {
        let (latents, has_camera) = (self.latents(), self.has_camera());
        let size = self.picture(width);
        let corner = |row: usize, column: usize| {
            [LEFT + column as f64 * (width + GAP), top + TOP + row as f64 * self.row(width)]
        };
        page.text(&self.scenario, [3.0, top + TOP - 4.5], Type::BOLD);
        for (column, trial) in self.trials.iter().enumerate() {
            let x = corner(0, column)[0] + width / 2.0;
            let motion = format!("motion {:.1} %", 100.0 * trial.motion);
            page.text(&motion, [x, top + TOP - 4.5], Type::SMALL);
            let mut pictures = Vec::new();
            if let (true, Some(bytes)) = (has_camera, &trial.camera) {
                let [rows, columns] = self.size.map(|pixels| pixels as u32);
                pictures.push(RgbImage::from_raw(columns, rows, bytes.clone()));
            }
            pictures.push(Some(colored(&trial.reference, self.size)));
            let predicted = latents.iter().map(|latent| trial.predicted.get(latent));
            pictures.extend(predicted.map(|change| change.map(|change| colored(change, self.size))));
            for (row, picture) in pictures.iter().enumerate() {
                // If a network has no prediction of this trial, its place stays empty.
                let Some(picture) = picture else { continue };
                page.picture(picture, corner(row, column), size, true)?;
                page.rectangle(corner(row, column), size, 0.0, "none", Some(Stroke::new(GRAY, 0.4)));
            }
        }
        let mut names: Vec<[String; 3]> = Vec::new();
        if has_camera {
            names.push(["camera".into(), "at *t*".into(), String::new()]);
        }
        names.push(["reference".into(), "change".into(), String::new()]);
        names.extend(latents.iter().map(|latent| {
            let error = self.errors.get(latent);
            let words = error.map_or(String::new(), |error| format!("error {}", mean_words(&error.mean)));
            // With one network, the mean is the error of the network that is shown.
            let shown = error.filter(|error| error.mean.bounds.is_some()).and_then(|error| error.shown);
            let shown = shown.map_or(String::new(), |error| format!("shown {error:.2}"));
            [format!("*z* = {latent}"), words, shown]
        }));
        for (row, [name, more, last]) in names.iter().enumerate() {
            let y = corner(row, 0)[1] + (self.row(width) - GAP) / 2.0;
            page.text(name, [LEFT - 4.0, y - 1.0], Type::LABEL.end());
            page.text(more, [LEFT - 4.0, y + 7.0], Type::SMALL.end());
            page.text(last, [LEFT - 4.0, y + 14.0], Type::SMALL.end());
        }
        Ok(())
    }
}

/// The blocks of the runs' scenarios, in the order of the runs.
fn blocks(runs: &Runs, image: Modality, camera: Modality) -> Result<Vec<Block>, FigureError> {
    let mut scenarios: Vec<String> =
        runs.all.iter().map(|run| run.record.spec.scenario.name().to_owned()).collect();
    scenarios.dedup();
    let block = |scenario: String| {
        let size = picture_size(runs, &scenario, image);
        let trials = trials(runs, &scenario, size, [image, camera])?;
        let errors = errors(runs, &scenario, image)?;
        Ok(Block { scenario, size, trials, errors })
    };
    scenarios.into_iter().map(block).collect()
}

/// Numbers of rows and columns of an image in a scenario, pixels.
fn picture_size(runs: &Runs, scenario: &str, image: Modality) -> [usize; 2] {
    let of_scenario = runs.all.iter().filter(|run| run.record.spec.scenario.name() == scenario);
    let mut sizes = of_scenario.filter_map(|run| run.record.layout.get(image)?.size());
    sizes.next_back().unwrap_or_default()
}

fn trials(
    runs: &Runs,
    scenario: &str,
    size: [usize; 2],
    [image, camera]: [Modality; 2],
) -> Result<Vec<Trial>, FigureError> {
    let place = format!("scenario = '{scenario}'");
    let rows = runs.query_first_seeds(&format!(
        "select latent, episode, sample, motion, reference, predicted from frames where {place} \
         and task = 'prediction' and modality = '{image}' order by motion, episode, sample, latent"
    ))?;
    let (latents, episodes, samples) =
        (integers(&rows, "latent")?, integers(&rows, "episode")?, integers(&rows, "sample")?);
    let motion = reals(&rows, "motion")?;
    let (references, predicted) = (rows.column("reference")?.binary()?, rows.column("predicted")?.binary()?);
    let mut trials: Vec<Trial> = Vec::new();
    for row in 0..rows.height() {
        let (episode, sample) = (episodes[row], samples[row]);
        if trials.last().is_none_or(|trial| (trial.episode, trial.sample) != (episode, sample)) {
            let reference = change(references.get(row), size)?;
            let motion = motion[row].unwrap_or_default();
            trials.push(Trial {
                episode,
                sample,
                motion,
                camera: None,
                reference,
                predicted: BTreeMap::new(),
            });
        }
        if let Some(trial) = trials.last_mut() {
            trial.predicted.insert(latents[row], change(predicted.get(row), size)?);
        }
    }
    trials.drain(..trials.len().saturating_sub(TRIALS));
    // Only runs with reconstruction have the picture before the change.
    let seen = runs.query_first_seeds(&format!(
        "select episode, sample, reference from frames where {place} and task = 'reconstruction' \
         and modality = '{camera}' order by latent"
    ));
    match seen {
        Err(error) if error.has_nothing_to_draw() => {}
        Err(error) => return Err(error),
        Ok(seen) => {
            let (episodes, samples) = (integers(&seen, "episode")?, integers(&seen, "sample")?);
            let pictures = seen.column("reference")?.binary()?;
            for trial in &mut trials {
                let before = (trial.episode, trial.sample - 1);
                let row = (0..seen.height()).find(|&row| (episodes[row], samples[row]) == before);
                trial.camera = row.and_then(|row| pictures.get(row)).map(<[u8]>::to_vec);
            }
        }
    }
    Ok(trials)
}

/// Decodes a stored frame difference and returns the mean over the three colors for each pixel. The meaning of the
/// table's column documents the encoding.
fn change(bytes: Option<&[u8]>, [rows, columns]: [usize; 2]) -> Result<Vec<f32>, FigureError> {
    let bytes = bytes.filter(|bytes| bytes.len() == rows * columns * IMAGE_CHANNELS);
    let bytes = bytes.ok_or_else(|| FigureError::Picture("a frame has the wrong size".into()))?;
    let pixel = |pixel: &[u8]| {
        pixel.iter().map(|&byte| (f32::from(byte) - 128.0) / 127.0).sum::<f32>() / IMAGE_CHANNELS as f32
    };
    Ok(bytes.chunks_exact(IMAGE_CHANNELS).map(pixel).collect())
}

/// The errors of the predicted change of the image, by latent size.
fn errors(runs: &Runs, scenario: &str, image: Modality) -> Result<BTreeMap<i64, RelativeError>, FigureError> {
    let sql = format!(
        "select latent, dataset_seed, value from metrics join runs using (experiment, run, scenario, latent) \
         where scenario = '{scenario}' and task = 'prediction' \
         and modality = '{image}' and model = 'network' and metric = 'relative_error'"
    );
    let (all, first) = (runs.query(&sql)?, runs.query_first_seeds(&sql)?);
    let values = integers(&all, "latent")?.into_iter().zip(replicated(&all)?);
    let means = intervals(values.map(|(latent, (seed, value))| (latent, seed, value)));
    let shown: BTreeMap<i64, Option<f64>> =
        integers(&first, "latent")?.into_iter().zip(reals(&first, "value")?).collect();
    let error =
        |(latent, mean)| (latent, RelativeError { mean, shown: shown.get(&latent).copied().flatten() });
    Ok(means.into_iter().map(error).collect())
}

fn color(change: f32) -> Rgb<u8> {
    let place = f64::from((change.clamp(-1.0, 1.0) + 1.0) / 2.0) * (COLORS.len() - 1) as f64;
    let below = (place.floor() as usize).min(COLORS.len() - 2);
    let part = place - below as f64;
    Rgb(std::array::from_fn(|channel| {
        (COLORS[below][channel] * (1.0 - part) + COLORS[below + 1][channel] * part).round() as u8
    }))
}

/// A picture of the changes, given row by row, of `rows` by `columns` pixels.
fn colored(change: &[f32], [rows, columns]: [usize; 2]) -> RgbImage {
    RgbImage::from_fn(columns as u32, rows as u32, |x, y| {
        color(change[y as usize * columns + x as usize] / RANGE)
    })
}

fn color_bar(page: &mut Page, top: f64) -> Result<(), FigureError> {
    let (width, height, left) = (110.0, 6.0, LEFT + (COLUMN - LEFT - 110.0) / 2.0);
    let bar = RgbImage::from_fn(111, 1, |x, _| color(x as f32 / 55.0 - 1.0));
    page.picture(&bar, [left, top], [width, height], false)?;
    page.rectangle([left, top], [width, height], 0.0, "none", Some(Stroke::new(GRAY, 0.4)));
    for (place, text) in [(0.0, format!("≤ \u{2212}{RANGE}")), (0.5, "0".into()), (1.0, format!("≥ {RANGE}"))]
    {
        page.text(&text, [left + place * width, top + height + 7.0], Type::SMALL);
    }
    let label = "change of intensity from *t* to *t* + 1, mean of RGB (1: black to white)";
    page.text(label, [LEFT + (COLUMN - LEFT) / 2.0, top + height + 16.0], Type::SMALL);
    Ok(())
}

/// A change that the figure shows, as the CSV file lists it.
struct Shown<'a> {
    scenario: &'a str,
    /// The trial's number within its scenario, from 1.
    number: u32,
    trial: &'a Trial,
    /// The latent size of the network that predicts the change. `None` for the reference.
    latent: Option<i64>,
    /// Numbers of rows and columns of the change, pixels.
    size: [usize; 2],
    change: &'a [f32],
}

/// The figure's CSV rows: one for each row of pixels of each shown change. Changes may differ in size.
fn data(blocks: &[Block], experiment: &str) -> Result<DataFrame, FigureError> {
    let mut shown = Vec::new();
    for block in blocks {
        let scenario = block.scenario.as_str();
        for (number, trial) in (1..).zip(&block.trials) {
            let show = |latent, change| Shown { scenario, number, trial, latent, size: block.size, change };
            shown.push(show(None, trial.reference.as_slice()));
            shown.extend(trial.predicted.iter().map(|(latent, change)| show(Some(*latent), change)));
        }
    }
    let rows: Vec<&Shown> =
        shown.iter().flat_map(|shown| std::iter::repeat_n(shown, shown.size[0])).collect();
    let pixel_rows = || shown.iter().flat_map(|shown| shown.change.chunks_exact(shown.size[1]));
    let width = shown.iter().map(|shown| shown.size[1]).max().unwrap_or_default();
    let model = |shown: &Shown| if shown.latent.is_some() { "network" } else { "reference" };
    let mut columns = vec![
        Column::new("experiment".into(), vec![experiment; rows.len()]),
        Column::new("scenario".into(), rows.iter().map(|row| row.scenario).collect::<Vec<_>>()),
        Column::new("trial".into(), rows.iter().map(|row| row.number).collect::<Vec<_>>()),
        Column::new("episode".into(), rows.iter().map(|row| row.trial.episode).collect::<Vec<_>>()),
        Column::new("sample".into(), rows.iter().map(|row| row.trial.sample).collect::<Vec<_>>()),
        Column::new("motion".into(), rows.iter().map(|row| row.trial.motion).collect::<Vec<_>>()),
        Column::new("model".into(), rows.iter().map(|row| model(row)).collect::<Vec<_>>()),
        Column::new("latent".into(), rows.iter().map(|row| row.latent).collect::<Vec<_>>()),
        Column::new("row".into(), shown.iter().flat_map(|shown| 0..shown.size[0] as u32).collect::<Vec<_>>()),
    ];
    columns.extend((0..width).map(|column| {
        // Narrower images have no value there.
        let values: Vec<Option<f32>> =
            pixel_rows().map(|row| row.get(column).map(|change| (change * 1e4).round() / 1e4)).collect();
        Column::new(format!("column_{column:02}").into(), values)
    }));
    Ok(DataFrame::new(rows.len(), columns)?)
}
