//! Decoders: from a latent state and an action to an observation.

use super::description::{ACTION, LATENT, Layer};
use super::layers::{Builder, FrameOutput, Perceptron};
use super::{Architecture, Decoded, Decoder, Targets, Term};
use crate::ops::{Quantity, Stack, frame_decoder, frame_loss, vector_losses};
use candle_core::{Result, Tensor};
use harness_spec::{Fusion, Modality};

/// Builds the decoder that an architecture describes.
pub(super) fn build(architecture: &Architecture, builder: &mut Builder) -> Result<Box<dyn Decoder>> {
    let vector = architecture.vector_width(&architecture.output);
    let (channels, size) = architecture.images(&architecture.output);
    let hidden =
        [&[architecture.latent + architecture.action], architecture.network.hidden.as_slice()].concat();
    let width = hidden[hidden.len() - 1];
    let shares = vector > 0 && channels > 0 && architecture.network.fusion == Fusion::Early;
    let mut shared = None;
    let mut vectors = None;
    if shares {
        shared = Some(builder.perceptron("hidden", &hidden)?);
        vectors = Some(builder.perceptron("vector", &[width, vector])?);
    } else if vector > 0 {
        let last = |builder: &mut Builder| builder.dense("vector", width, vector);
        vectors = Some(builder.perceptron("hidden", &hidden)?.then("vector", last(builder)?));
    }
    let frames = (channels > 0)
        .then(|| {
            let name = if vector > 0 { "frame_hidden" } else { "hidden" };
            let own = (!shares).then(|| builder.perceptron(name, &hidden)).transpose()?;
            let stack = Stack::new(channels, size, architecture.network.channels());
            let dense = builder.dense("frame", width, stack.coarse_len())?;
            let convolutions = builder.transposed_convolutions(&stack)?;
            let output = FrameOutput { stack, convolutions, dense, arithmetic: architecture.arithmetic };
            Ok::<_, candle_core::Error>((own, output))
        })
        .transpose()?;
    let (frame_hidden, frames) = frames.map_or((None, None), |(own, output)| (own, Some(output)));
    Ok(Box::new(PerceptronDecoder {
        condition: [architecture.latent, architecture.action],
        vectors_of: vectors_of(architecture),
        shared,
        vectors,
        frame_hidden,
        frames,
    }))
}

/// Returns the vectors that are predicted, side by side, with their widths.
fn vectors_of(architecture: &Architecture) -> Vec<(Modality, usize)> {
    let vectors = architecture.output.iter().filter(|modality| !architecture.is_image(**modality));
    vectors.map(|modality| (*modality, architecture.layout[*modality].width())).collect()
}

/// Hidden layers, which vectors and frames share or have separately, and the output layers of both.
struct PerceptronDecoder {
    /// Widths of the latent state and of the action; the latter is 0 without an action.
    condition: [usize; 2],
    /// The predicted vectors with their widths. They lie side by side.
    vectors_of: Vec<(Modality, usize)>,
    /// Hidden layers that vectors and frames share.
    shared: Option<Perceptron>,
    /// Layers that predict the vectors from the shared layers' output, or from the latent state and the action.
    vectors: Option<Perceptron>,
    /// Hidden layers for the frames alone.
    frame_hidden: Option<Perceptron>,
    frames: Option<FrameOutput>,
}

/// Inputs of the layers that vectors and frames do not share.
struct Hidden {
    /// Input of the vectors' layers.
    vectors: Tensor,
    /// Input of the frames' fully connected output layer.
    frames: Tensor,
}

impl PerceptronDecoder {
    fn hidden(&self, latent: &Tensor, action: Option<&Tensor>) -> Result<Hidden> {
        let condition = match action {
            Some(action) => Tensor::cat(&[latent, action], 1)?,
            None => latent.clone(),
        };
        let vectors = match &self.shared {
            Some(shared) => shared.forward(&condition, true)?,
            None => condition,
        };
        let frames = match &self.frame_hidden {
            Some(own) => own.forward(&vectors, true)?,
            None => vectors.clone(),
        };
        Ok(Hidden { vectors, frames })
    }

    fn vectors(&self, hidden: &Hidden) -> Result<Option<Tensor>> {
        self.vectors.as_ref().map(|layers| layers.forward(&hidden.vectors, false)).transpose()
    }
}

impl Decoder for PerceptronDecoder {
    fn decode(&self, latent: &Tensor, action: Option<&Tensor>) -> Result<Decoded> {
        let hidden = self.hidden(latent, action)?;
        let frames = self.frames.as_ref().map(|output| {
            let channels = output.stack.layers()[0].fine_channels;
            frame_decoder(&hidden.frames, &output.decoder(0, channels)?)
        });
        Ok(Decoded { vector: self.vectors(&hidden)?, frames: frames.transpose()? })
    }

    fn losses(&self, latent: &Tensor, action: Option<&Tensor>, targets: &Targets) -> Result<Vec<Term>> {
        let hidden = self.hidden(latent, action)?;
        let mut terms = Vec::new();
        if let (Some(predicted), Some(target)) = (self.vectors(&hidden)?, &targets.vector) {
            let loss = |modality: &Modality| targets.losses.get(modality).copied().unwrap_or_default();
            let quantity =
                |(modality, width): &(Modality, usize)| Quantity { width: *width, loss: loss(modality) };
            let quantities: Vec<Quantity> = self.vectors_of.iter().map(quantity).collect();
            let losses = vector_losses(&predicted, target, &quantities)?;
            for (index, (modality, _)) in self.vectors_of.iter().enumerate() {
                terms.push(Term { modality: *modality, value: losses.get(index)? });
            }
        }
        let mut first = 0;
        for (modality, target) in &targets.frames {
            if let Some(output) = &self.frames {
                let decoder = output.decoder(first, target.channels())?;
                terms.push(Term {
                    modality: *modality,
                    value: frame_loss(&hidden.frames, decoder, target.clone())?,
                });
            }
            first += target.channels();
        }
        Ok(terms)
    }

    fn detached(&self) -> Box<dyn Decoder> {
        let detached = |layers: &Option<Perceptron>| layers.as_ref().map(Perceptron::detached);
        Box::new(Self {
            condition: self.condition,
            vectors_of: self.vectors_of.clone(),
            shared: detached(&self.shared),
            vectors: detached(&self.vectors),
            frame_hidden: detached(&self.frame_hidden),
            frames: self.frames.as_ref().map(FrameOutput::detached),
        })
    }

    fn layers(&self) -> Result<Vec<Layer>> {
        let last = |layers: &[Layer], otherwise: &str| {
            layers.last().map_or(otherwise, |layer| layer.name.as_str()).to_owned()
        };
        let [latent, action] = self.condition;
        let mut layers = Vec::new();
        if action > 0 {
            layers.push(Layer::concatenate("condition", &[LATENT, ACTION], latent + action));
        }
        if let Some(shared) = &self.shared {
            layers.extend(shared.layers(&last(&layers, LATENT), true)?);
        }
        let common = last(&layers, LATENT);
        if let Some(vectors) = &self.vectors {
            layers.extend(vectors.layers(&common, false)?);
        }
        if let Some(frames) = &self.frames {
            let own = self.frame_hidden.as_ref().map(|own| own.layers(&common, true)).transpose()?;
            let own = own.unwrap_or_default();
            let input = last(&own, &common);
            layers.extend(own);
            layers.extend(frames.layers(&input)?);
        }
        Ok(layers)
    }
}
