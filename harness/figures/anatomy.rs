//! What a diagram shows of a network: the layers that the network lists, and their order.

use super::FigureError;
use super::source::{Source, Study};
use candle_core::Device;
use harness_learning::LearningError;
use harness_learning::network::description::{
    ACTION, Activation, Convolution, ENCODED, IMAGES, LATENT, Layer, Operation, POSTERIOR, PRIOR, VECTORS,
};
use harness_learning::network::{Architecture, Parameters, architecture};
use harness_learning::random::{Random, Stream};
use harness_spec::{Definition, Layout, Modality, RunSpec, Task, Trained};
use polars::prelude::*;
use std::cmp::Reverse;
use std::sync::Arc;

/// The inputs, outputs and layers of a task's networks.
pub struct Anatomy {
    /// The networks' task.
    pub task: Task,
    /// The modalities that the encoder is given.
    pub input: Vec<Definition>,
    /// The modalities that the decoder gives.
    pub output: Vec<Definition>,
    /// The latent sizes of the runs, ascending.
    latents: Vec<usize>,
    /// The width of the decoder's action; 0 without an action.
    pub action: usize,
    /// The networks, one for each of the latent sizes.
    networks: Vec<Layers>,
}

/// The layers and parameters of a network.
struct Layers {
    /// The layers of the encoder, and of the memory after it.
    encoder: Vec<Layer>,
    decoder: Vec<Layer>,
    /// The parameters' names and shapes.
    parameters: Vec<(String, Vec<usize>)>,
}

impl Layers {
    /// Builds a run's network for a task as training builds it. A reconstruction has the encoder and the memory of the
    /// prediction.
    fn of(spec: &RunSpec, trained: &Trained, layout: &Arc<Layout>, task: Task) -> candle_core::Result<Self> {
        let [prediction, own] =
            [Task::Prediction, task].map(|task| architecture(spec, trained, layout, task));
        let (mut parameters, mut random) =
            (Parameters::new(), Random::new(spec.seed, Stream::Parameters(task)));
        prediction.network(&mut parameters, &mut random, &Device::Cpu)?;
        parameters.retain(|name, _| !name.starts_with(DECODER));
        let decoder = own.decoder(&mut parameters, &mut random, &Device::Cpu)?.layers()?;
        let mut memory = prediction.memory_layers()?;
        // Only samples that are seen are reconstructed.
        memory.retain(|layer| task == Task::Prediction || !layer.name.starts_with(PRIOR));
        let encoder = with_memory(prediction.encoder_layers()?, memory);
        let parameters = parameters.iter().map(|(name, var)| (name.clone(), var.dims().to_vec()));
        Ok(Self { encoder, decoder, parameters: parameters.collect() })
    }
}

/// First part of the names of an encoder's parameters.
const ENCODER: &str = "encoder";
/// First part of the names of a decoder's parameters.
const DECODER: &str = "decoder";

/// The layers of an encoder, and those of the memory after it, if there is one. The last one of the former is then
/// [`ENCODED`], and the names of the others differ from those of the latter.
fn with_memory(mut encoder: Vec<Layer>, memory: Vec<Layer>) -> Vec<Layer> {
    if memory.is_empty() {
        return encoder;
    }
    let renamed = |name: &str| match name {
        POSTERIOR => ENCODED.to_owned(),
        VECTORS | IMAGES => name.to_owned(),
        _ => format!("{ENCODER}.{name}"),
    };
    for layer in &mut encoder {
        layer.name = renamed(&layer.name);
        layer.inputs.iter_mut().for_each(|input| *input = renamed(input));
    }
    encoder.extend(memory);
    encoder
}

impl Anatomy {
    /// Builds the networks of the multi-to-multi runs as training builds them, one for each latent size.
    ///
    /// # Errors
    /// When the runs are missing, they have no such task, or a network can't be built.
    pub fn of(source: &Source, task: Task) -> Result<Self, FigureError> {
        let runs = source.runs(Study::MultiToMulti)?;
        let latents = runs.latents();
        let spec = &runs.all[0].record.spec;
        let Some(trained) = spec.trained().filter(|_| spec.tasks.contains(&task)) else {
            return Err(runs.no_rows());
        };
        let layout = runs.layout();
        let Architecture { input, output, action, .. } = architecture(spec, trained, layout, task);
        let definitions = |names: Vec<Modality>| names.iter().map(|name| layout[*name].clone()).collect();
        let (input, output) = (definitions(input), definitions(output));
        let build =
            |latent: &usize| Layers::of(spec, &Trained { latent: *latent, ..trained.clone() }, layout, task);
        let networks = latents.iter().map(build).collect::<Result<_, _>>().map_err(LearningError::from)?;
        Ok(Self { task, input, output, latents, action, networks })
    }

    /// The latent sizes in words, for example "16, 64 or 128".
    pub fn latent_words(&self) -> String {
        any_of(self.latents.iter().copied())
    }

    /// Whether the networks have a memory after the encoder.
    pub fn has_memory(&self) -> bool {
        self.networks[0].encoder.iter().any(|layer| layer.name == ENCODED)
    }

    /// The smallest and the largest number of parameters of the networks, in words.
    pub fn parameter_words(&self) -> String {
        let count = |network: &Layers| -> usize {
            network.parameters.iter().map(|(_, shape)| shape.iter().product::<usize>()).sum()
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
                network.parameters.iter().map(|(name, shape)| (*latent, name.as_str(), shape.as_slice()))
            })
            .collect();
        let shape = |shape: &[usize]| shape.iter().map(usize::to_string).collect::<Vec<_>>().join(" x ");
        Ok(df!(
            "task" => vec![self.task.name(); rows.len()],
            "latent" => rows.iter().map(|(latent, ..)| *latent as u32).collect::<Vec<_>>(),
            "parameter" => rows.iter().map(|(_, parameter, _)| *parameter).collect::<Vec<_>>(),
            "shape" => rows.iter().map(|(.., dims)| shape(dims)).collect::<Vec<_>>(),
            "values" => rows.iter().map(|(.., dims)| dims.iter().product::<usize>() as u64).collect::<Vec<_>>(),
        )?)
    }
}

/// Different numbers in words, for example "16, 64 or 128".
fn any_of(numbers: impl Iterator<Item = usize>) -> String {
    let mut words: Vec<String> = numbers.map(|number| number.to_string()).collect();
    words.dedup();
    match words.as_slice() {
        [first @ .., before, last] => {
            let first: String = first.iter().map(|word| format!("{word}, ")).collect();
            format!("{first}{before} or {last}")
        }
        _ => words.concat(),
    }
}

/// The column of a block: that of images, that of vectors, or both.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Lane {
    /// Values that come from images alone, or lead to images alone.
    Images,
    /// Values that come from vectors alone, or lead to vectors alone.
    Vectors,
    /// All others.
    Both,
}

/// A layer in the diagram.
pub struct Block<'a> {
    /// The name of the layer and of the value that it gives.
    pub name: &'a str,
    /// The block's column.
    pub lane: Lane,
    /// Number of arrows on the longest way from the latent state.
    pub depth: usize,
    /// The block's position from the left in its row of the column, and the number of blocks in it.
    pub position: [usize; 2],
    /// Number of arrows that pass the row at its right.
    pub passing: usize,
    /// What the layer computes, and the values that it gives.
    pub lines: Vec<String>,
    /// Whether a ReLU follows, for which the lines have no room.
    pub relu_beside: bool,
}

/// An encoder with its memory, or a decoder, in the diagram. Its arrows connect the latent state and the action with
/// [`IMAGES`] and [`VECTORS`], which it is given or gives.
pub struct Part<'a> {
    /// First part of the parameters' names.
    prefix: &'static str,
    /// The layers at each latent size.
    layers: Vec<&'a [Layer]>,
    /// The parameters' names and shapes at the smallest latent size.
    parameters: &'a [(String, Vec<usize>)],
    /// Pairs of connected values, of which the first is nearer to the latent state.
    pub pairs: Vec<(&'a str, &'a str)>,
    /// The modalities at its other end.
    pub modalities: &'a [Definition],
}

impl<'a> Part<'a> {
    /// The encoder of the networks, and the memory after it.
    pub fn encoder(anatomy: &'a Anatomy) -> Self {
        let layers = anatomy.networks.iter().map(|network| network.encoder.as_slice()).collect();
        let mut part = Self::new(ENCODER, layers, anatomy, &anatomy.input);
        let names: Vec<&str> = part.drawn().map(|layer| layer.name.as_str()).collect();
        // A memory also takes values of the sample before, which its block names.
        part.pairs.retain(|(input, _)| [IMAGES, VECTORS].contains(input) || names.contains(input));
        part.pairs.iter_mut().for_each(|(input, layer)| std::mem::swap(input, layer));
        let ends = [POSTERIOR, PRIOR].into_iter().filter(|end| names.contains(end));
        part.pairs.extend(ends.map(|end| (LATENT, end)));
        part
    }

    /// The decoder of the networks.
    pub fn decoder(anatomy: &'a Anatomy) -> Self {
        let layers = anatomy.networks.iter().map(|network| network.decoder.as_slice()).collect();
        let mut part = Self::new(DECODER, layers, anatomy, &anatomy.output);
        let ends = part.layers[0].iter().filter(|layer| consumers(part.layers[0], &layer.name) == 0);
        let end =
            |layer: &'a Layer| (layer.name.as_str(), if layer.output.len() > 1 { IMAGES } else { VECTORS });
        part.pairs.extend(ends.map(end).collect::<Vec<_>>());
        part
    }

    /// A part whose pairs are those of a layer's input and the layer.
    fn new(
        prefix: &'static str,
        layers: Vec<&'a [Layer]>,
        anatomy: &'a Anatomy,
        modalities: &'a [Definition],
    ) -> Self {
        let parameters = anatomy.networks[0].parameters.as_slice();
        let mut part = Self { prefix, layers, parameters, pairs: Vec::new(), modalities };
        let pairs = part.drawn().flat_map(|layer| {
            inputs(part.layers[0], layer).into_iter().map(|input| (input, layer.name.as_str()))
        });
        part.pairs = pairs.collect();
        part
    }

    /// The layers that have blocks.
    fn drawn(&self) -> impl Iterator<Item = &'a Layer> + use<'a> {
        let layers = self.layers[0];
        layers.iter().filter(|layer| is_drawn(layers, layer))
    }

    /// The values next to this one, on the side of the latent state.
    fn nearer(&self, name: &str) -> impl Iterator<Item = &'a str> {
        self.pairs.iter().filter(move |(_, far)| *far == name).map(|(near, _)| *near)
    }

    /// The values next to this one, on the other side.
    fn farther(&self, name: &str) -> impl Iterator<Item = &'a str> {
        self.pairs.iter().filter(move |(near, _)| *near == name).map(|(_, far)| *far)
    }

    /// Number of arrows on the longest way from the latent state to a value.
    fn depth(&self, name: &str) -> usize {
        self.nearer(name).map(|near| 1 + self.depth(near)).max().unwrap_or(0)
    }

    /// Whether data flow towards the latent state.
    pub fn is_encoder(&self) -> bool {
        self.prefix == ENCODER
    }

    /// The layers that have blocks, in the order of the list.
    pub fn blocks(&self) -> Vec<Block<'a>> {
        self.drawn().map(|layer| self.block(layer)).collect()
    }

    fn block(&self, layer: &'a Layer) -> Block<'a> {
        let (lane, depth) = self.row(&layer.name);
        let mut row: Vec<&str> = self.drawn().map(|layer| layer.name.as_str()).collect();
        row.retain(|name| self.row(name) == (lane, depth));
        // What follows from the sample is below it, and what a memory expects is beside it.
        row.sort_by_key(|name| Reverse(self.reaches(name, IMAGES) || self.reaches(name, VECTORS)));
        let index = row.iter().position(|name| *name == layer.name).unwrap_or(0);
        let passing = self.passing(lane);
        let is_passed = passing.iter().any(|pair| self.is_between(depth, pair));
        let passing = if is_passed { passing.len() } else { 0 };
        let room = match (lane, row.len()) {
            (lane, 1) => lane,
            (Lane::Both, 2) => Lane::Images,
            _ => Lane::Vectors,
        };
        let is_narrow = lane == Lane::Vectors && row.len() > 1;
        let (lines, relu_beside) = (self.lines(layer, room, is_narrow), has_relu_beside(layer, room));
        Block { name: &layer.name, lane, depth, position: [index, row.len()], passing, lines, relu_beside }
    }

    /// The column and the depth of a value.
    fn row(&self, name: &str) -> (Lane, usize) {
        (self.lane(name), self.depth(name))
    }

    /// The column of an arrow.
    pub fn lane_of(&self, (near, far): &(&str, &str)) -> Lane {
        match self.lane(near) {
            Lane::Both => self.lane(far),
            lane => lane,
        }
    }

    /// Whether an arrow passes the row of this depth.
    fn is_between(&self, depth: usize, (near, far): &(&str, &str)) -> bool {
        (self.depth(near) + 1..self.depth(far)).contains(&depth)
    }

    /// The pairs whose arrows pass blocks of a column, at their right.
    pub fn passing(&self, lane: Lane) -> Vec<(&'a str, &'a str)> {
        let passes = |pair: &&(&'a str, &'a str)| {
            let is_passed = |layer: &Layer| {
                self.lane(&layer.name) == lane && self.is_between(self.depth(&layer.name), pair)
            };
            self.lane_of(pair) == lane && self.drawn().any(is_passed)
        };
        self.pairs.iter().filter(passes).copied().collect()
    }

    fn reaches(&self, name: &str, end: &str) -> bool {
        name == end || self.farther(name).any(|far| self.reaches(far, end))
    }

    /// The column of a value. A part with vectors or images alone has a single wide column.
    pub fn lane(&self, name: &str) -> Lane {
        let images = self.modalities.iter().filter(|modality| modality.is_image()).count();
        if images == 0 || images == self.modalities.len() {
            return Lane::Both;
        }
        match (self.reaches(name, IMAGES), self.reaches(name, VECTORS)) {
            (true, false) => Lane::Images,
            (false, true) => Lane::Vectors,
            _ => Lane::Both,
        }
    }

    /// What a block that is as wide as this column says about a layer: what it computes, and the values that it gives.
    /// In a narrow block, a fully connected layer has only its letters.
    fn lines(&self, layer: &Layer, room: Lane, is_narrow: bool) -> Vec<String> {
        let short = |whole: &str, short: &str| if room == Lane::Both { whole } else { short }.to_owned();
        let all = self.layers[0];
        let reshaped = all
            .iter()
            .find(|other| other.operation == Operation::Reshape && other.inputs.contains(&layer.name));
        let width = |layers: &&[Layer]| {
            let same = layers.iter().find(|other| other.name == layer.name);
            same.map_or(0, |layer| layer.output.iter().product())
        };
        let given = match reshaped.unwrap_or(layer).output.as_slice() {
            [channels, rows, columns] => format!("{rows} × {columns} × {channels}"),
            [objects, width] => format!("{objects} × {width}"),
            _ => any_of(self.layers.iter().map(width)),
        };
        let kernel = |Convolution { weight, stride, .. }: &Convolution| {
            let name = format!("{}.{weight}", self.prefix);
            let found = self.parameters.iter().find(|(parameter, _)| *parameter == name);
            let sides = found.map_or_else(String::new, |(_, dims)| format!("{} × {}", dims[2], dims[3]));
            format!("{sides}, stride {stride}")
        };
        match &layer.operation {
            Operation::Dense { activation, .. } => {
                let name = if is_narrow { "FC".into() } else { short("fully connected", "fully conn.") };
                let relu = *activation == Activation::Relu && room != Lane::Vectors;
                let is_distribution = [POSTERIOR, PRIOR].contains(&layer.name.as_str());
                let means = if is_distribution { "*μ*, log *σ*²: " } else { "" };
                vec![if relu { name + ", ReLU" } else { name }, format!("{means}{given}")]
            }
            Operation::Convolution(convolution) => vec!["convolution".into(), kernel(convolution), given],
            Operation::TransposedConvolution(convolution) => {
                vec![short("transposed convolution", "transposed conv."), kernel(convolution), given]
            }
            Operation::GatedRecurrentUnit { .. } => {
                vec![short("gated recurrent unit", "GRU"), format!("with {}", before(layer)), given]
            }
            Operation::LastSamples { samples } => {
                vec![format!("last {samples} samples"), format!("each with {}", before(layer)), given]
            }
            Operation::LayerNormalization { .. } => vec![short("layer normalization", "layer norm."), given],
            Operation::ProductOfExperts { .. } => {
                vec![short("product of experts", "product"), format!("*μ*, log *σ*²: {given}")]
            }
            Operation::Average { size } => vec![format!("mean of {size} × {size} pixels"), given],
            Operation::SumAndMaximum { objects } => {
                vec![short(&format!("sum and maximum of {objects}"), "sum, maximum"), given]
            }
            Operation::Concatenate
            | Operation::Columns { .. }
            | Operation::Objects { .. }
            | Operation::Flatten
            | Operation::Reshape => {
                vec!["side by side".into(), given]
            }
        }
    }
}

/// The values of the sample before that a memory takes: `*z*_{t-1}, *a*_{t-1}`.
fn before(memory: &Layer) -> String {
    let names = [(LATENT, "*z*_{t-1}"), (ACTION, "*a*_{t-1}")];
    let taken = names.iter().filter(|(name, _)| memory.inputs.iter().any(|input| input == name));
    taken.map(|(_, words)| *words).collect::<Vec<_>>().join(", ")
}

/// Whether a ReLU follows a layer whose block has no room to say so.
fn has_relu_beside(layer: &Layer, room: Lane) -> bool {
    let activation = match &layer.operation {
        Operation::Dense { activation, .. } if room == Lane::Vectors => *activation,
        Operation::Convolution(of) | Operation::TransposedConvolution(of) => of.activation,
        _ => Activation::None,
    };
    activation == Activation::Relu
}

/// Number of layers that take a layer's output.
fn consumers(layers: &[Layer], name: &str) -> usize {
    layers.iter().filter(|layer| layer.inputs.iter().any(|input| input == name)).count()
}

/// Whether a layer has a block. A layer that only arranges values for the next layer has none.
fn is_drawn(layers: &[Layer], layer: &Layer) -> bool {
    match layer.operation {
        Operation::Columns { .. } | Operation::Objects { .. } | Operation::Flatten | Operation::Reshape => {
            false
        }
        Operation::Concatenate => consumers(layers, &layer.name) > 1,
        _ => true,
    }
}

/// The drawn layers, or values given to the encoder or decoder, that a layer takes.
fn inputs<'a>(layers: &'a [Layer], layer: &'a Layer) -> Vec<&'a str> {
    let drawn = |input: &'a String| match layers.iter().find(|other| other.name == *input) {
        Some(other) if !is_drawn(layers, other) => inputs(layers, other),
        _ => vec![input.as_str()],
    };
    layer.inputs.iter().flat_map(drawn).collect()
}
