//! The vectors of an observation as one input of an encoder. The objects of a set go through layers that all share.
//!
//! The sum and the maximum over the objects do not depend on their order (Zaheer et al., 2017, *Deep Sets*).

use super::description::{Layer, Operation, VECTORS};
use super::layers::{Builder, Perceptron};
use super::{Architecture, Observation, Value};
use candle_core::{Result, Tensor};
use harness_spec::Modality;

/// Name of the encoder's input if there is a set among the vectors.
const JOINED: &str = "vectors_and_sets";
/// Name of the vectors that are no sets, if there is a set among the vectors.
const OTHERS: &str = "other_vectors";

/// The vectors of an encoder's input.
pub struct VectorInput {
    /// The vectors that are no sets.
    others: Vec<Modality>,
    /// Start and length of each of them among the columns of all vectors.
    ranges: Vec<[usize; 2]>,
    sets: Vec<SetInput>,
}

/// The layers of a set of objects.
struct SetInput {
    modality: Modality,
    /// Index of its first column among those of all vectors.
    start: usize,
    objects: usize,
    /// Number of values of an object.
    columns: usize,
    shared: Perceptron,
    /// Number of values that the shared layers compute for an object.
    width: usize,
}

impl VectorInput {
    /// Creates the layers of the sets among `vectors`: two for each, as wide as the encoder's first hidden layer.
    pub fn new(architecture: &Architecture, vectors: &[Modality], builder: &mut Builder) -> Result<Self> {
        Self::starting_at(0, architecture, vectors, builder)
    }

    /// Creates the layers of the sets among `vectors`, the first of which starts at this column of all vectors.
    pub fn starting_at(
        mut start: usize,
        architecture: &Architecture,
        vectors: &[Modality],
        builder: &mut Builder,
    ) -> Result<Self> {
        let mut input = Self { others: Vec::new(), ranges: Vec::new(), sets: Vec::new() };
        for modality in vectors.iter().copied() {
            let definition = &architecture.layout[modality];
            let len = definition.width();
            if let Some(objects) = definition.objects {
                let (columns, width) = (len / objects, architecture.network.hidden[0]);
                let shared = builder.perceptron(&format!("set_{modality}"), &[columns, width, width])?;
                input.sets.push(SetInput { modality, start, objects, columns, shared, width });
            } else {
                input.others.push(modality);
                input.ranges.push([start, len]);
            }
            start += len;
        }
        Ok(input)
    }

    /// Number of values of a sample.
    pub fn width(&self) -> usize {
        self.others_width() + self.sets.iter().map(|set| 2 * set.width).sum::<usize>()
    }

    fn others_width(&self) -> usize {
        self.ranges.iter().map(|[_, len]| len).sum()
    }

    /// Name of the value that [`Self::forward`] computes.
    pub fn name(&self) -> &'static str {
        if self.sets.is_empty() { VECTORS } else { JOINED }
    }

    /// Returns the values of a batch, `[batch, width]`.
    pub fn forward(&self, observation: &Observation) -> Result<Tensor> {
        if self.sets.is_empty() {
            return observation.vectors(&self.others);
        }
        let others = (!self.others.is_empty()).then(|| observation.vectors(&self.others));
        let sets = self.sets.iter().map(|set| set.forward(observation));
        Tensor::cat(&others.into_iter().chain(sets).collect::<Result<Vec<_>>>()?, 1)
    }

    /// Returns the same input without gradients.
    pub fn detached(&self) -> Self {
        Self {
            others: self.others.clone(),
            ranges: self.ranges.clone(),
            sets: self.sets.iter().map(SetInput::detached).collect(),
        }
    }

    /// Describes the layers of a single vector, which take it from all vectors. The last one gives what
    /// [`Self::forward`] computes.
    pub fn layers_of_one(&self) -> Result<Vec<Layer>> {
        match self.sets.as_slice() {
            [set] => set.layers(),
            _ => {
                let operation = Operation::Columns { ranges: self.ranges.clone() };
                let name = format!("vector_{}", self.others[0]);
                let output = vec![self.others_width()];
                Ok(vec![Layer::without_parameters(&name, operation, VECTORS, output)])
            }
        }
    }

    /// Describes the layers; none without sets.
    pub fn layers(&self) -> Result<Vec<Layer>> {
        if self.sets.is_empty() {
            return Ok(Vec::new());
        }
        let (mut layers, mut parts) = (Vec::new(), Vec::new());
        if !self.others.is_empty() {
            let ranges = self.ranges.clone();
            let output = vec![self.others_width()];
            layers.push(Layer::without_parameters(OTHERS, Operation::Columns { ranges }, VECTORS, output));
            parts.push(OTHERS.to_owned());
        }
        for set in &self.sets {
            layers.extend(set.layers()?);
            parts.push(set.pooled());
        }
        let parts: Vec<&str> = parts.iter().map(String::as_str).collect();
        layers.push(Layer::concatenate(JOINED, &parts, self.width()));
        Ok(layers)
    }
}

impl SetInput {
    fn forward(&self, observation: &Observation) -> Result<Tensor> {
        let Some(Value::Vector(values)) = observation.get(self.modality) else {
            candle_core::bail!("the observation lacks the set '{}'", self.modality)
        };
        let batch = values.dim(0)?;
        let rows = values.reshape((batch * self.objects, self.columns))?;
        let shared = self.shared.forward(&rows, true)?.reshape((batch, self.objects, self.width))?;
        Tensor::cat(&[shared.sum(1)?, shared.max(1)?], 1)
    }

    fn detached(&self) -> Self {
        Self { shared: self.shared.detached(), ..*self }
    }

    /// Name of the layer after the shared ones.
    fn pooled(&self) -> String {
        format!("set_{}_pooled", self.modality)
    }

    fn layers(&self) -> Result<Vec<Layer>> {
        let (start, objects) = (self.start, self.objects);
        let rows = format!("set_{}_objects", self.modality);
        let output = vec![objects, self.columns];
        let mut layers =
            vec![Layer::without_parameters(&rows, Operation::Objects { start, objects }, VECTORS, output)];
        for mut layer in self.shared.layers(&rows, true)? {
            layer.output.insert(0, objects);
            layers.push(layer);
        }
        let last = layers[layers.len() - 1].name.clone();
        let pool = Operation::SumAndMaximum { objects };
        layers.push(Layer::without_parameters(&self.pooled(), pool, &last, vec![2 * self.width]));
        Ok(layers)
    }
}
