//! Draws a network's layers from the shapes of its parameters. Two figures show such a diagram.

use super::FigureError;
use super::page::{BLACK, GRAY, Page, Point, Stroke, Type, WHITE};
use super::source::{Source, Study};
use super::text::Face;
use candle_core::Device;
use harness_learning::LearningError;
use harness_learning::network::{Parameters, architecture};
use harness_learning::random::{Random, Stream};
use harness_spec::{Definition, Fusion, IMAGE_CHANNELS, Layout, Modality, Network, RunSpec, Task};
use polars::prelude::*;
use std::sync::Arc;

/// Fill color of inputs and outputs.
pub const INPUT: &str = "#d8ebf7";
/// Fill color of the latent state.
pub const LATENT: &str = "#fdebc8";
/// Fill color of the action.
pub const ACTION: &str = "#d5efe4";
/// Fill color of layers that aren't trained.
pub const FROZEN: &str = "#e2e2e2";
/// Stroke of the arrows between blocks.
pub const LINE: Stroke = Stroke::new(BLACK, 0.7);

/// The inputs, outputs and parameters of a task's networks.
pub struct Anatomy {
    /// The networks' task.
    pub task: Task,
    /// The modalities that the encoder is given.
    pub input: Vec<Definition>,
    /// The modalities that the decoder gives.
    pub output: Vec<Definition>,
    /// The latent sizes of the runs, ascending.
    pub latents: Vec<usize>,
    /// The parameters' names and shapes, for each of the latent sizes.
    networks: Vec<Vec<(String, Vec<usize>)>>,
}

impl Anatomy {
    /// Builds the networks of the multi-to-multi runs as training builds them, one for each latent size.
    ///
    /// # Errors
    /// When the runs are missing, the diagram can't show their networks, or a network can't be built.
    pub fn of(source: &Source, task: Task) -> Result<Self, FigureError> {
        let runs = source.runs(Study::MultiToMulti)?;
        let latents = runs.latents();
        let spec = &runs.all[0].record.spec;
        let architecture = architecture(spec, runs.layout(), task);
        let definitions = |names: &[Modality]| {
            names.iter().map(|name| (**runs.layout())[*name].clone()).collect::<Vec<Definition>>()
        };
        let (input, output) = (definitions(&architecture.input), definitions(&architecture.output));
        let has = not_shown(&spec.network, input.iter().chain(&output).any(Definition::is_image));
        if !has.is_empty() {
            let (experiment, command) = (runs.experiment.clone(), runs.show_command());
            return Err(FigureError::OtherNetwork { experiment, has, command });
        }
        let build =
            |latent: &usize| shapes(&RunSpec { latent: *latent, ..spec.clone() }, runs.layout(), task);
        let networks = latents.iter().map(build).collect::<Result<_, _>>()?;
        Ok(Self { task, input, output, latents, networks })
    }

    /// The shape of a parameter at the smallest latent size. Only the layers next to the latent state depend on the
    /// latent size.
    fn shape(&self, name: &str) -> Option<&[usize]> {
        self.networks[0].iter().find(|(found, _)| found == name).map(|(_, shape)| shape.as_slice())
    }

    /// `factor` times the latent sizes in words, for example "16, 64 or 128".
    fn latent_words(&self, factor: usize) -> String {
        let sizes: Vec<String> = self.latents.iter().map(|latent| (factor * latent).to_string()).collect();
        match sizes.as_slice() {
            [one] => one.clone(),
            [first @ .., last] => format!("{} or {last}", first.join(", ")),
            [] => String::new(),
        }
    }

    /// The smallest and the largest number of parameters of the networks, in words.
    pub fn parameter_words(&self) -> String {
        let count = |network: &Vec<(String, Vec<usize>)>| -> usize {
            network.iter().map(|(_, shape)| shape.iter().product::<usize>()).sum()
        };
        let millions = |count: usize| {
            if count < 1_000_000 {
                format!("{:.1} thousand", count as f64 / 1e3)
            } else {
                format!("{:.2} million", count as f64 / 1e6)
            }
        };
        let mut counts: Vec<usize> = self.networks.iter().map(count).collect();
        counts.sort_unstable();
        let (first, last) = (millions(counts[0]), millions(counts[counts.len() - 1]));
        if first == last { format!("{first} parameters") } else { format!("{first} to {last} parameters") }
    }

    /// The figure's CSV rows: every parameter with its shape, at every latent size.
    ///
    /// # Errors
    /// When Polars can't build the table.
    pub fn data(&self) -> Result<DataFrame, FigureError> {
        let rows: Vec<(usize, &str, &[usize])> = self
            .latents
            .iter()
            .zip(&self.networks)
            .flat_map(|(latent, network)| {
                network.iter().map(|(name, shape)| (*latent, name.as_str(), shape.as_slice()))
            })
            .collect();
        let shape = |shape: &[usize]| shape.iter().map(usize::to_string).collect::<Vec<_>>().join(" x ");
        Ok(df!(
            "task" => vec![self.task.name(); rows.len()],
            "latent" => rows.iter().map(|row| row.0 as u32).collect::<Vec<_>>(),
            "parameter" => rows.iter().map(|row| row.1).collect::<Vec<_>>(),
            "shape" => rows.iter().map(|row| shape(row.2)).collect::<Vec<_>>(),
            "values" => rows.iter().map(|row| row.2.iter().product::<usize>() as u64).collect::<Vec<_>>(),
        )?)
    }
}

/// What a network has that the diagram can't show, such as `2 hidden layers`.
fn not_shown(network: &Network, has_images: bool) -> Vec<String> {
    let (hidden, convolutions) = (network.hidden.len(), network.channels().len());
    let parts = [
        (hidden > 1, format!("{hidden} hidden layers")),
        (has_images && convolutions > 1, format!("{convolutions} convolutions")),
        (has_images && network.average > 1, "averaged images".to_owned()),
        (network.fusion != Fusion::Early, format!("{} fusion", network.fusion)),
    ];
    parts.into_iter().filter(|(is_there, _)| *is_there).map(|(_, words)| words).collect()
}

/// Names and shapes of the parameters of a run's network for a task.
fn shapes(
    spec: &RunSpec,
    layout: &Arc<Layout>,
    task: Task,
) -> Result<Vec<(String, Vec<usize>)>, FigureError> {
    let architecture = architecture(spec, layout, task);
    let (mut parameters, mut random) = (Parameters::new(), Random::new(spec.seed, Stream::Parameters(task)));
    architecture.encoder(&mut parameters, &mut random, &Device::Cpu).map_err(LearningError::from)?;
    architecture.decoder(&mut parameters, &mut random, &Device::Cpu).map_err(LearningError::from)?;
    Ok(parameters.iter().map(|(name, var)| (name.clone(), var.dims().to_vec())).collect())
}

/// Draws a box with centered lines of text. The first line is bold.
pub fn block(page: &mut Page, center: Point, size: [f64; 2], fill: &str, lines: &[String]) {
    let corner = [center[0] - size[0] / 2.0, center[1] - size[1] / 2.0];
    page.rectangle(corner, size, 2.0, fill, Some(Stroke::new(GRAY, 0.6)));
    let leading = 7.6;
    for (index, line) in lines.iter().enumerate() {
        let y = center[1] + 2.2 + leading * (index as f64 - (lines.len() as f64 - 1.0) / 2.0);
        let face = if index == 0 { Face::Bold } else { Face::Regular };
        page.text(line, [center[0], y], Type { face, ..Type::SMALL });
    }
}

/// A modality's name for people, and its shape.
fn modality_lines(modality: &Definition) -> Vec<String> {
    let shape = match modality.size() {
        Some([rows, columns]) => format!("{rows} × {columns} × {IMAGE_CHANNELS}"),
        None => modality.width().to_string(),
    };
    vec![modality.name.name().replace('_', " "), shape]
}

/// Height of a block with two lines, points.
const TWO: f64 = 20.0;
/// Height of a block with three lines, points.
const THREE: f64 = 27.5;
/// Width of blocks in the column for frames, points.
const WIDE: f64 = 62.0;
/// Width of blocks in the column for vectors, which is beside the column for frames, points.
const NARROW: f64 = 50.0;
const BETWEEN: f64 = 4.0;
/// Distance from one row of blocks to the next, points.
const STEP: f64 = 36.0;
const COLUMN_WIDTH: f64 = WIDE + BETWEEN + NARROW;

/// Draws the network from `top` on. Data flow downwards through the encoder at the left, and upwards through the
/// decoder at the right. Returns the diagram's height in points.
pub fn network(page: &mut Page, width: f64, top: f64, anatomy: &Anatomy) -> f64 {
    let frozen = anatomy.task == Task::Reconstruction;
    let left = 2.0;
    let right = width - 2.0 - COLUMN_WIDTH;
    let tallest = tallest(&anatomy.input).max(tallest(&anatomy.output));
    let row = |index: usize| top + 13.0 + tallest - TWO / 2.0 + index as f64 * STEP;
    encoder(page, left, row, anatomy, if frozen { FROZEN } else { WHITE });
    decoder(page, right, row, anatomy);
    let heading = |page: &mut Page, left: f64, text: &str| {
        page.text(text, [left + COLUMN_WIDTH / 2.0, top + 7.0], Type { face: Face::Italic, ..Type::LABEL });
    };
    heading(
        page,
        left,
        if frozen { "fusion encoder *f*, trained before, frozen" } else { "fusion encoder *f*" },
    );
    heading(page, right, if frozen { "reconstruction decoder *r*" } else { "predictive decoder *p*" });
    latent(page, [left, right], row(4), anatomy);
    row(4) + THREE / 2.0 - top
}

/// Horizontal centers of the column for frames, of the column for vectors, and of both together.
fn centers(left: f64) -> [f64; 3] {
    [left + WIDE / 2.0, left + WIDE + BETWEEN + NARROW / 2.0, left + COLUMN_WIDTH / 2.0]
}

fn encoder(page: &mut Page, left: f64, row: impl Fn(usize) -> f64, anatomy: &Anatomy, fill: &str) {
    let [frames, vectors, both] = centers(left);
    let stride = stride(anatomy, "encoder.hidden_frame.weight", 1, "encoder.conv.weight", &anatomy.input);
    if let (Some(kernel), Some(stride)) = (anatomy.shape("encoder.conv.weight"), stride) {
        let [rows, columns] = image_size(&anatomy.input).map(|side| side / stride);
        stack(page, frames, row(0), WIDE, anatomy.input.iter().filter(|modality| modality.is_image()));
        let lines = vec![
            "convolution".into(),
            format!("{} × {}, stride {stride}", kernel[2], kernel[3]),
            format!("{rows} × {columns} × {}", kernel[0]),
        ];
        block(page, [frames, row(1)], [WIDE, THREE], fill, &lines);
        page.arrow(&[[frames, row(0) + TWO / 2.0], [frames, row(1) - THREE / 2.0]], LINE);
        page.arrow(&[[frames, row(1) + THREE / 2.0], [frames, row(2) - TWO / 2.0]], LINE);
        page.text(
            "ReLU",
            [frames + 3.0, row(1) + THREE / 2.0 + 7.5],
            Type { size: 5.6, ..Type::SMALL.start().color(GRAY) },
        );
    }
    if anatomy.shape("encoder.hidden_vector.weight").is_some() {
        stack(page, vectors, row(0), NARROW, anatomy.input.iter().filter(|modality| !modality.is_image()));
        page.arrow(&[[vectors, row(0) + TWO / 2.0], [vectors, row(2) - TWO / 2.0]], LINE);
    }
    let hidden = anatomy.shape("encoder.hidden.bias").map_or(0, |shape| shape[0]);
    let lines = ["fully connected, ReLU".to_owned(), hidden.to_string()];
    block(page, [both, row(2)], [COLUMN_WIDTH, TWO], fill, &lines);
    let lines = ["fully connected".to_owned(), format!("*μ*, log *σ*²: {}", anatomy.latent_words(2))];
    block(page, [both, row(3)], [COLUMN_WIDTH, TWO], fill, &lines);
    page.arrow(&[[both, row(2) + TWO / 2.0], [both, row(3) - TWO / 2.0]], LINE);
}

fn decoder(page: &mut Page, left: f64, row: impl Fn(usize) -> f64, anatomy: &Anatomy) {
    let [frames, vectors, both] = centers(left);
    let frame_outputs = || anatomy.output.iter().filter(|modality| modality.is_image());
    let stride = stride(anatomy, "decoder.frame.weight", 0, "decoder.conv.weight", &anatomy.output);
    if let (Some(kernel), Some(stride)) = (anatomy.shape("decoder.conv.weight"), stride) {
        let [fine_rows, fine_columns] = image_size(&anatomy.output);
        let [rows, columns] = image_size(&anatomy.output).map(|side| side / stride);
        stack(page, frames, row(0), WIDE, frame_outputs());
        let lines = vec![
            "transposed conv.".into(),
            format!("{} × {}, stride {stride}", kernel[2], kernel[3]),
            format!("{fine_rows} × {fine_columns} × {}", kernel[1]),
        ];
        block(page, [frames, row(1)], [WIDE, THREE], WHITE, &lines);
        let lines = ["fully conn., ReLU".to_owned(), format!("{rows} × {columns} × {}", kernel[0])];
        block(page, [frames, row(2)], [WIDE, TWO], WHITE, &lines);
        page.arrow(&[[frames, row(1) - THREE / 2.0], [frames, row(0) + TWO / 2.0]], LINE);
        page.arrow(&[[frames, row(2) - TWO / 2.0], [frames, row(1) + THREE / 2.0]], LINE);
        page.arrow(&[[frames, row(3) - TWO / 2.0], [frames, row(2) + TWO / 2.0]], LINE);
    }
    if let Some(shape) = anatomy.shape("decoder.vector.weight") {
        stack(page, vectors, row(0), NARROW, anatomy.output.iter().filter(|modality| !modality.is_image()));
        let lines = ["fully conn.".to_owned(), shape[0].to_string()];
        block(page, [vectors, row(2)], [NARROW, TWO], WHITE, &lines);
        page.arrow(&[[vectors, row(2) - TWO / 2.0], [vectors, row(0) + TWO / 2.0]], LINE);
        page.arrow(&[[vectors, row(3) - TWO / 2.0], [vectors, row(2) + TWO / 2.0]], LINE);
    }
    let hidden = anatomy.shape("decoder.hidden.bias").map_or(0, |shape| shape[0]);
    let lines = ["fully connected, ReLU".to_owned(), hidden.to_string()];
    block(page, [both, row(3)], [COLUMN_WIDTH, TWO], WHITE, &lines);
}

/// Draws the latent state between encoder and decoder, and for predictions the action beside it.
fn latent(page: &mut Page, [left, right]: [f64; 2], y: f64, anatomy: &Anatomy) {
    let (encoder, decoder) = (centers(left)[2], centers(right)[2]);
    let acting = anatomy.task == Task::Prediction;
    let how = if acting { "sampled: *μ* + *σε*" } else { "the mean *μ*" };
    let size = [62.0, THREE];
    let center = [if acting { encoder + 46.0 } else { (encoder + decoder) / 2.0 }, y];
    let lines = ["latent state *z*".to_owned(), anatomy.latent_words(1), how.to_owned()];
    block(page, center, size, LATENT, &lines);
    let above = y - STEP + TWO / 2.0;
    page.arrow(&[[encoder, above], [encoder, y], [center[0] - size[0] / 2.0, y]], LINE);
    let enter = if acting { decoder - 32.0 } else { decoder };
    page.arrow(&[[center[0] + size[0] / 2.0, y], [enter, y], [enter, above]], LINE);
    if acting {
        let width = anatomy.shape("decoder.hidden.weight").map_or(0, |shape| shape[1] - anatomy.latents[0]);
        let place = [decoder + 24.0, y];
        block(page, place, [60.0, TWO], ACTION, &["action *a*_{t}".to_owned(), width.to_string()]);
        page.arrow(&[[place[0], y - TWO / 2.0], [place[0], above]], LINE);
    }
}

/// The convolution's stride, computed from the shapes of parameters. Between the convolution and the fully connected
/// layer `dense` lies a coarse picture for each of the convolution's channels. Their number of pixels gives the stride.
fn stride(
    anatomy: &Anatomy,
    dense: &str,
    axis: usize,
    convolution: &str,
    modalities: &[Definition],
) -> Option<usize> {
    let values = anatomy.shape(dense)?[axis] / anatomy.shape(convolution)?[0];
    let [rows, columns] = image_size(modalities);
    Some((rows * columns / values).isqrt())
}

/// Rows and columns of the first image among modalities, pixels. Without an image, both are 0.
fn image_size(modalities: &[Definition]) -> [usize; 2] {
    modalities.iter().find_map(Definition::size).unwrap_or_default()
}

/// Height of the taller one of the two stacks of `modalities`, frames and vectors, in points.
fn tallest(modalities: &[Definition]) -> f64 {
    let frames = modalities.iter().filter(|modality| modality.is_image()).count();
    stack_height(frames.max(modalities.len() - frames))
}

fn stack_height(count: usize) -> f64 {
    if count > 1 { count as f64 * 15.5 + 4.0 } else { TWO }
}

/// Draws one block with the names of all `modalities`. Its lower edge is that of a block with two lines at `y`.
fn stack<'a>(page: &mut Page, x: f64, y: f64, width: f64, modalities: impl Iterator<Item = &'a Definition>) {
    let modalities: Vec<_> = modalities.collect();
    let height = stack_height(modalities.len());
    let y = y - (height - TWO) / 2.0;
    if let [one] = modalities.as_slice() {
        block(page, [x, y], [width, height], INPUT, &modality_lines(one));
        return;
    }
    page.rectangle(
        [x - width / 2.0, y - height / 2.0],
        [width, height],
        2.0,
        INPUT,
        Some(Stroke::new(GRAY, 0.6)),
    );
    let lines: Vec<String> = modalities.iter().flat_map(|modality| modality_lines(modality)).collect();
    for (index, line) in lines.iter().enumerate() {
        let y = y + 2.2 + 7.6 * (index as f64 - (lines.len() as f64 - 1.0) / 2.0);
        let face = if index % 2 == 0 { Face::Bold } else { Face::Regular };
        page.text(line, [x, y], Type { face, ..Type::SMALL });
    }
}
