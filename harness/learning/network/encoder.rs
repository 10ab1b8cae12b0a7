//! Encoders: from an observation to a posterior.

use super::description::{Activation, Layer, Operation, POSTERIOR};
use super::layers::{Builder, Dense, FLAT, FrameInput, Norm, Perceptron, numbered};
use super::vectors::VectorInput;
use super::{Architecture, Encoder, Expert, LEAST_LOG_VARIANCE, Observation, Posterior};
use candle_core::{DType, Result, Tensor};
use harness_ops::frames::Frames;
use harness_ops::{Arithmetic, Dropout, Stack};
use harness_spec::{Fusion, IMAGE_CHANNELS, Modality};
use std::sync::Arc;

/// Builds the encoder that an architecture describes.
pub(super) fn build(architecture: &Architecture, builder: &mut Builder) -> Result<Box<dyn Encoder>> {
    let [vectors, images] = architecture.parts(&architecture.input);
    Ok(match architecture.network.fusion {
        Fusion::Early if images.is_empty() => Box::new(VectorEncoder::new(architecture, vectors, builder)?),
        Fusion::Early => Box::new(EarlyEncoder::new(architecture, vectors, images, builder)?),
        Fusion::Product => Box::new(ProductEncoder::new(architecture, vectors, images, builder)?),
        Fusion::Late => Box::new(LateEncoder::new(architecture, vectors, images, builder)?),
    })
}

/// Builds the convolutions for images, and the weight of the fully connected layer after them.
fn frame_input(
    architecture: &Architecture,
    images: &[Modality],
    weight: &str,
    outputs: usize,
    builder: &mut Builder,
) -> Result<FrameInput> {
    let average = architecture.network.average;
    let size = architecture.size(images).map(|side| side / average);
    let stack = Stack::new(images.len() * IMAGE_CHANNELS, size, architecture.network.channels());
    let convolutions = builder.convolutions(&stack, false)?;
    let len = stack.coarse_len();
    let weight = builder.uniform(weight, &[outputs, len], len)?;
    Ok(FrameInput { stack, average, convolutions, weight, arithmetic: architecture.arithmetic })
}

/// Appends all hidden layers except the first, and the layer of the posterior.
fn to_posterior(
    mut layers: Perceptron,
    architecture: &Architecture,
    builder: &mut Builder,
) -> Result<Perceptron> {
    let hidden = &architecture.network.hidden;
    for (index, pair) in hidden.windows(2).enumerate() {
        let name = numbered("hidden", index + 1);
        let layer = builder.dense(&name, pair[0], pair[1])?;
        layers = layers.then(&name, layer);
    }
    let last = builder.dense(POSTERIOR, hidden[hidden.len() - 1], 2 * architecture.latent)?;
    Ok(layers.then(POSTERIOR, last))
}

/// Describes the first fully connected layer of an encoder that joins frames and vectors in it.
fn first_layer(weights: &[&str]) -> Operation {
    Operation::Dense {
        weights: weights.iter().map(|weight| (*weight).to_owned()).collect(),
        bias: "hidden.bias".into(),
        activation: Activation::Relu,
    }
}

/// Fully connected layers on vectors alone.
struct VectorEncoder {
    vectors: VectorInput,
    layers: Perceptron,
}

impl VectorEncoder {
    fn new(architecture: &Architecture, vectors: Vec<Modality>, builder: &mut Builder) -> Result<Self> {
        let vectors = VectorInput::new(architecture, &vectors, builder)?;
        let vector = vectors.width();
        let hidden = &architecture.network.hidden;
        // The parameters have the same names as those of the first layer in an encoder with frames.
        let first = Dense {
            weight: builder.uniform("hidden_vector.weight", &[hidden[0], vector], vector)?,
            bias: builder.uniform("hidden.bias", &[hidden[0]], vector)?,
        };
        let layers = Perceptron::empty(builder.arithmetic).then("hidden", first);
        Ok(Self { vectors, layers: to_posterior(layers, architecture, builder)? })
    }
}

impl Encoder for VectorEncoder {
    fn encode_with_dropout(&self, observation: &Observation, _dropout: Option<Dropout>) -> Result<Posterior> {
        Ok(Posterior(self.layers.forward(&self.vectors.forward(observation)?, false)?))
    }

    fn detached(&self) -> Box<dyn Encoder> {
        Box::new(Self { vectors: self.vectors.detached(), layers: self.layers.detached() })
    }

    fn layers(&self) -> Result<Vec<Layer>> {
        let mut dense = self.layers.layers(self.vectors.name(), false)?;
        // Its weight has the same name as in an encoder with frames.
        dense[0].operation = first_layer(&["hidden_vector.weight"]);
        let mut layers = self.vectors.layers()?;
        layers.extend(dense);
        Ok(layers)
    }
}

/// Joins frames and vectors in the first fully connected layer.
struct EarlyEncoder {
    vectors: VectorInput,
    images: Vec<Modality>,
    frames: FrameInput,
    /// Weight of the first layer for the vectors, if there are any. Frames and vectors are two blocks of one layer, and
    /// each is initialized by its own fan-in. With a joint fan-in, a few joint angles would initially have little
    /// weight next to thousands of image values.
    weight: Option<Tensor>,
    bias: Tensor,
    /// The other hidden layers and the layer of the posterior.
    rest: Perceptron,
}

impl EarlyEncoder {
    fn new(
        architecture: &Architecture,
        vectors: Vec<Modality>,
        images: Vec<Modality>,
        builder: &mut Builder,
    ) -> Result<Self> {
        let hidden = &architecture.network.hidden;
        let vectors = VectorInput::new(architecture, &vectors, builder)?;
        let vector = vectors.width();
        let frames = frame_input(architecture, &images, "hidden_frame.weight", hidden[0], builder)?;
        let fan_in = vector + frames.stack.coarse_len();
        let weight = (vector > 0)
            .then(|| builder.uniform("hidden_vector.weight", &[hidden[0], vector], vector))
            .transpose()?;
        let bias = builder.uniform("hidden.bias", &[hidden[0]], fan_in)?;
        let rest = to_posterior(Perceptron::empty(builder.arithmetic), architecture, builder)?;
        Ok(Self { vectors, images, frames, weight, bias, rest })
    }
}

impl Encoder for EarlyEncoder {
    fn encode_with_dropout(&self, observation: &Observation, dropout: Option<Dropout>) -> Result<Posterior> {
        let seen = self.frames.forward(&observation.frames(&self.images)?, dropout)?;
        let hidden = match &self.weight {
            Some(weight) => {
                let layer = Dense { weight: weight.clone(), bias: self.bias.clone() };
                (seen + layer.forward(&self.vectors.forward(observation)?, false, self.frames.arithmetic)?)?
            }
            None => seen.broadcast_add(&self.bias)?,
        };
        Ok(Posterior(self.rest.forward(&hidden.relu()?, false)?))
    }

    fn detached(&self) -> Box<dyn Encoder> {
        Box::new(Self {
            vectors: self.vectors.detached(),
            images: self.images.clone(),
            frames: self.frames.detached(),
            weight: self.weight.as_ref().map(Tensor::detach),
            bias: self.bias.detach(),
            rest: self.rest.detached(),
        })
    }

    fn layers(&self) -> Result<Vec<Layer>> {
        let parts = [(FLAT, "hidden_frame.weight"), (self.vectors.name(), "hidden_vector.weight")];
        let (inputs, weights): (Vec<_>, Vec<_>) =
            parts.into_iter().take(1 + usize::from(self.weight.is_some())).unzip();
        let mut layers = self.vectors.layers()?;
        layers.extend(self.frames.layers());
        layers.push(Layer {
            name: "hidden".into(),
            operation: first_layer(&weights),
            inputs: inputs.into_iter().map(String::from).collect(),
            output: vec![self.bias.dim(0)?],
            parameters: self.frames.weight.elem_count()
                + self.weight.as_ref().map_or(0, Tensor::elem_count)
                + self.bias.elem_count(),
        });
        layers.extend(self.rest.layers("hidden", false)?);
        Ok(layers)
    }
}

/// Encodes frames and vectors separately, normalizes both results, and joins them in one more layer.
struct LateEncoder {
    vectors: VectorInput,
    images: Vec<Modality>,
    vector: Option<(Perceptron, Norm)>,
    frames: Option<(FrameLayers, Norm)>,
    joint: Dense,
    posterior: Dense,
    arithmetic: Arithmetic,
}

/// Convolutions of frames and a fully connected layer with a ReLU, which see nothing but frames.
struct FrameLayers {
    input: FrameInput,
    bias: Tensor,
}

impl FrameLayers {
    fn new(
        architecture: &Architecture,
        images: &[Modality],
        width: usize,
        builder: &mut Builder,
    ) -> Result<Self> {
        let input = frame_input(architecture, images, "frame.weight", width, builder)?;
        let bias = builder.uniform("frame.bias", &[width], input.stack.coarse_len())?;
        Ok(Self { input, bias })
    }

    fn forward(&self, frames: &Arc<dyn Frames>, dropout: Option<Dropout>) -> Result<Tensor> {
        self.input.forward(frames, dropout)?.broadcast_add(&self.bias)?.relu()
    }

    fn detached(&self) -> Self {
        Self { input: self.input.detached(), bias: self.bias.detach() }
    }

    /// Describes the layers. The last of them is `frame`.
    fn layers(&self) -> Result<Vec<Layer>> {
        let dense = Dense { weight: self.input.weight.clone(), bias: self.bias.clone() };
        let mut layers = self.input.layers();
        layers.push(dense.layer("frame", FLAT, true)?);
        Ok(layers)
    }
}

impl LateEncoder {
    fn new(
        architecture: &Architecture,
        vectors: Vec<Modality>,
        images: Vec<Modality>,
        builder: &mut Builder,
    ) -> Result<Self> {
        let hidden = &architecture.network.hidden;
        let width = hidden[hidden.len() - 1];
        let vectors = VectorInput::new(architecture, &vectors, builder)?;
        let vector = vectors.width();
        let frames = (!images.is_empty())
            .then(|| {
                let layers = FrameLayers::new(architecture, &images, width, builder)?;
                Ok::<_, candle_core::Error>((layers, builder.norm("frame_norm", width)?))
            })
            .transpose()?;
        let vector = (vector > 0)
            .then(|| {
                let widths = [&[vector], hidden.as_slice()].concat();
                Ok::<_, candle_core::Error>((
                    builder.perceptron("vector", &widths)?,
                    builder.norm("vector_norm", width)?,
                ))
            })
            .transpose()?;
        let inputs = (usize::from(frames.is_some()) + usize::from(vector.is_some())) * width;
        let joint = builder.dense("joint", inputs, width)?;
        let posterior = builder.dense(POSTERIOR, width, 2 * architecture.latent)?;
        Ok(Self { vectors, images, vector, frames, joint, posterior, arithmetic: architecture.arithmetic })
    }
}

impl Encoder for LateEncoder {
    fn encode_with_dropout(&self, observation: &Observation, dropout: Option<Dropout>) -> Result<Posterior> {
        let mut parts = Vec::new();
        if let Some((perceptron, norm)) = &self.vector {
            parts.push(norm.forward(&perceptron.forward(&self.vectors.forward(observation)?, true)?)?);
        }
        if let Some((layers, norm)) = &self.frames {
            parts.push(norm.forward(&layers.forward(&observation.frames(&self.images)?, dropout)?)?);
        }
        let joint = self.joint.forward(&Tensor::cat(&parts, 1)?, true, self.arithmetic)?;
        Ok(Posterior(self.posterior.forward(&joint, false, self.arithmetic)?))
    }

    fn detached(&self) -> Box<dyn Encoder> {
        Box::new(Self {
            vectors: self.vectors.detached(),
            images: self.images.clone(),
            vector: self.vector.as_ref().map(|(perceptron, norm)| (perceptron.detached(), norm.detached())),
            frames: self.frames.as_ref().map(|(layers, norm)| (layers.detached(), norm.detached())),
            joint: self.joint.detached(),
            posterior: self.posterior.detached(),
            arithmetic: self.arithmetic,
        })
    }

    fn layers(&self) -> Result<Vec<Layer>> {
        let mut layers = Vec::new();
        let mut parts = Vec::new();
        if let Some((perceptron, norm)) = &self.vector {
            layers.extend(self.vectors.layers()?);
            layers.extend(perceptron.layers(self.vectors.name(), true)?);
            layers.push(norm.layer("vector_norm", &layers[layers.len() - 1].name)?);
            parts.push("vector_norm");
        }
        if let Some((of_frames, norm)) = &self.frames {
            layers.extend(of_frames.layers()?);
            layers.push(norm.layer("frame_norm", "frame")?);
            parts.push("frame_norm");
        }
        layers.push(Layer::concatenate("parts", &parts, self.joint.weight.dim(1)?));
        layers.push(self.joint.layer("joint", "parts", true)?);
        layers.push(self.posterior.layer(POSTERIOR, "joint", false)?);
        Ok(layers)
    }
}

/// Encodes each vector and all images separately, each to a distribution of the latent state. The posterior is the
/// product of these experts and of the prior. Source: Wu & Goodman, 2018, *Multimodal generative models for scalable
/// weakly-supervised learning*.
struct ProductEncoder {
    vectors: Vec<VectorExpert>,
    images: Option<ImageExpert>,
    latent: usize,
}

/// The layers of a vector in a [`ProductEncoder`].
struct VectorExpert {
    modality: Modality,
    input: VectorInput,
    layers: Perceptron,
}

/// The layers of all images in a [`ProductEncoder`].
struct ImageExpert {
    images: Vec<Modality>,
    frames: FrameLayers,
    layers: Perceptron,
}

impl ProductEncoder {
    fn new(
        architecture: &Architecture,
        vectors: Vec<Modality>,
        images: Vec<Modality>,
        builder: &mut Builder,
    ) -> Result<Self> {
        let hidden = architecture.network.hidden.as_slice();
        let latent = architecture.latent;
        let mut start = 0;
        let mut expert = |modality: Modality| {
            let input = VectorInput::starting_at(start, architecture, &[modality], builder)?;
            start += architecture.layout[modality].width();
            let widths = [&[input.width()], hidden, &[2 * latent]].concat();
            let layers = builder.perceptron(&format!("expert_{modality}"), &widths)?;
            Ok(VectorExpert { modality, input, layers })
        };
        let vectors = vectors.into_iter().map(&mut expert).collect::<Result<_>>()?;
        let mut expert = |images: Vec<Modality>| {
            let frames = FrameLayers::new(architecture, &images, hidden[0], builder)?;
            let layers = builder.perceptron("expert_images", &[hidden, &[2 * latent]].concat())?;
            Ok::<_, candle_core::Error>(ImageExpert { images, frames, layers })
        };
        let images = (!images.is_empty()).then(|| expert(images)).transpose()?;
        Ok(Self { vectors, images, latent })
    }
}

impl Encoder for ProductEncoder {
    fn encode_with_dropout(&self, observation: &Observation, dropout: Option<Dropout>) -> Result<Posterior> {
        let mut experts = Vec::new();
        for VectorExpert { modality, input, layers } in &self.vectors {
            let posterior = layers.forward(&input.forward(observation)?, false)?;
            let kept = observation.kept(&[*modality], posterior.device())?;
            experts.push(Expert { posterior: Posterior(posterior), kept });
        }
        if let Some(ImageExpert { images, frames, layers }) = &self.images {
            let hidden = frames.forward(&observation.frames(images)?, dropout)?;
            let posterior = layers.forward(&hidden, false)?;
            let kept = observation.kept(images, posterior.device())?;
            experts.push(Expert { posterior: Posterior(posterior), kept });
        }
        let of_all = &experts[0].posterior.0;
        let prior = Tensor::zeros((of_all.dim(0)?, 2 * self.latent), DType::F32, of_all.device())?;
        experts.push(Expert { posterior: Posterior(prior), kept: None });
        Posterior::product(&experts)
    }

    fn detached(&self) -> Box<dyn Encoder> {
        let vectors = self.vectors.iter().map(|expert| VectorExpert {
            modality: expert.modality,
            input: expert.input.detached(),
            layers: expert.layers.detached(),
        });
        let images = self.images.as_ref().map(|expert| ImageExpert {
            images: expert.images.clone(),
            frames: expert.frames.detached(),
            layers: expert.layers.detached(),
        });
        Box::new(Self { vectors: vectors.collect(), images, latent: self.latent })
    }

    fn layers(&self) -> Result<Vec<Layer>> {
        let (mut layers, mut experts) = (Vec::new(), Vec::new());
        for expert in &self.vectors {
            layers.extend(expert.input.layers_of_one()?);
            let input = layers[layers.len() - 1].name.clone();
            layers.extend(expert.layers.layers(&input, false)?);
            experts.push(layers[layers.len() - 1].name.clone());
        }
        if let Some(ImageExpert { frames, layers: of_images, .. }) = &self.images {
            layers.extend(frames.layers()?);
            layers.extend(of_images.layers("frame", false)?);
            experts.push(layers[layers.len() - 1].name.clone());
        }
        layers.push(Layer {
            name: POSTERIOR.into(),
            operation: Operation::ProductOfExperts { least_log_variance: LEAST_LOG_VARIANCE },
            inputs: experts,
            output: vec![2 * self.latent],
            parameters: 0,
        });
        Ok(layers)
    }
}
