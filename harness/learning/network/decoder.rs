//! Decoders: from a latent state and an action to an observation.

use super::description::{ACTION, LATENT, Layer};
use super::head::{Head, heads};
use super::layers::{Builder, FrameOutput, Perceptron};
use super::{Architecture, Decoded, Decoder, Score, Spreads, Targets, Term};
use candle_core::{Result, Tensor};
use candle_nn::ops::softmax;
use harness_ops::{
    Quantity, Stack, categorical_cross_entropy, cosine_losses, frame_decoder, frame_loss, frames,
    vector_losses,
};
use harness_spec::{Definition, Fusion, IMAGE_CHANNELS, Modality};
use std::collections::{BTreeMap, BTreeSet};

/// Builds the decoder that an architecture describes.
pub(super) fn build(architecture: &Architecture, builder: &mut Builder) -> Result<Box<dyn Decoder>> {
    let [vectors_of, images_of] = architecture.parts(&architecture.output);
    let (mut heads, vector) = heads(architecture, &vectors_of);
    for (modality, head) in &mut heads {
        if let Some([zero, threshold]) = architecture.hurdles.get(modality) {
            head.bounds = Some([builder.constant(zero)?, builder.constant(threshold)?]);
        }
    }
    let with = |is: fn(&Definition) -> bool| {
        vectors_of.iter().copied().filter(|modality| is(&architecture.layout[*modality])).collect()
    };
    let categories = with(|definition| definition.category);
    let unit_vectors = with(|definition| definition.unit_vectors);
    let size = architecture.size(&images_of);
    let channels = images_of.len() * IMAGE_CHANNELS;
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
            let convolutions = builder.convolutions(&stack, true)?;
            let output = FrameOutput { stack, convolutions, dense, arithmetic: architecture.arithmetic };
            Ok::<_, candle_core::Error>((own, output))
        })
        .transpose()?;
    let with_width = |modality: Modality| (modality, architecture.layout[modality].width());
    let (frame_hidden, frames) = frames.map_or((None, None), |(own, output)| (own, Some(output)));
    Ok(Box::new(PerceptronDecoder {
        condition: [architecture.latent, architecture.action],
        heads,
        categories,
        unit_vectors,
        vectors_of: vectors_of.into_iter().map(with_width).collect(),
        images_of,
        shared,
        vectors,
        frame_hidden,
        frames,
    }))
}

/// Hidden layers, which vectors and frames share or have separately, and the output layers of both.
struct PerceptronDecoder {
    /// Widths of the latent state and of the action; the latter is 0 without an action.
    condition: [usize; 2],
    /// The predicted vectors with their widths. They lie side by side.
    vectors_of: Vec<(Modality, usize)>,
    /// The vectors of which a distribution is predicted. Their other parameters follow all vectors.
    heads: BTreeMap<Modality, Head>,
    /// The vectors whose probabilities are the softmax of their columns.
    categories: BTreeSet<Modality>,
    /// The vectors of which only directions are learned.
    unit_vectors: BTreeSet<Modality>,
    /// The predicted images. They are stacked by channel.
    images_of: Vec<Modality>,
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
            Some(action) if self.condition[1] > 0 => Tensor::cat(&[latent, action], 1)?,
            _ => latent.clone(),
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

    /// Returns the loss of a vector that is not learned by the error of each element.
    fn own_loss(&self, modality: Modality) -> Option<fn(&Tensor, &Tensor) -> Result<Tensor>> {
        match modality {
            modality if self.categories.contains(&modality) => Some(categorical_cross_entropy),
            modality if self.unit_vectors.contains(&modality) => Some(cosine_losses),
            _ => None,
        }
    }

    fn side_by_side(&self, hidden: &Hidden) -> Result<Option<Tensor>> {
        self.vectors.as_ref().map(|layers| layers.forward(&hidden.vectors, false)).transpose()
    }
}

impl Decoder for PerceptronDecoder {
    fn decode(&self, latent: &Tensor, action: Option<&Tensor>) -> Result<Decoded> {
        let hidden = self.hidden(latent, action)?;
        let mut decoded = Decoded::new();
        if let Some(vectors) = self.side_by_side(&hidden)? {
            let mut first = 0;
            for (modality, width) in &self.vectors_of {
                let columns = || vectors.narrow(1, first, *width)?.contiguous();
                let values = match self.heads.get(modality) {
                    Some(head) => head.means(&vectors)?,
                    None if self.categories.contains(modality) => softmax(&columns()?, 1)?,
                    None => columns()?,
                };
                decoded.insert(*modality, values);
                first += width;
            }
        }
        if let Some(output) = &self.frames {
            let channels = self.images_of.len() * IMAGE_CHANNELS;
            let frames = frame_decoder(&hidden.frames, &output.decoder(0, channels)?)?;
            for (index, modality) in self.images_of.iter().enumerate() {
                let image = frames.narrow(1, index * IMAGE_CHANNELS, IMAGE_CHANNELS)?;
                decoded.insert(*modality, image.contiguous()?);
            }
        }
        Ok(decoded)
    }

    fn spreads(&self, latent: &Tensor, action: Option<&Tensor>) -> Result<Spreads> {
        if self.heads.is_empty() {
            return Ok(Spreads::new());
        }
        let outputs = self.side_by_side(&self.hidden(latent, action)?)?;
        let outputs = outputs.iter().flat_map(|outputs| self.heads.iter().map(move |head| (outputs, head)));
        outputs.map(|(outputs, (modality, head))| Ok((*modality, head.spread(outputs)?))).collect()
    }

    fn vectors(&self) -> &[(Modality, usize)] {
        &self.vectors_of
    }

    fn losses(&self, latent: &Tensor, action: Option<&Tensor>, targets: Targets) -> Result<Vec<Term>> {
        let hidden = self.hidden(latent, action)?;
        let mut terms = Vec::new();
        if let Some(outputs) = self.side_by_side(&hidden)? {
            let width = self.vectors_of.iter().map(|(_, width)| width).sum();
            let predicted = outputs.narrow(1, 0, width)?.contiguous()?;
            let predicted = targets.added.map_or(Ok(predicted.clone()), |added| predicted + added)?;
            let loss = |modality: &Modality| targets.losses.get(modality).copied().unwrap_or_default();
            let quantity =
                |(modality, width): &(Modality, usize)| Quantity { width: *width, loss: loss(modality) };
            let quantities: Vec<Quantity> = self.vectors_of.iter().map(quantity).collect();
            let vectors: Vec<Modality> = self.vectors_of.iter().map(|(modality, _)| *modality).collect();
            let target = targets.values.vectors(&vectors)?;
            let losses = vector_losses(&predicted, &target, &quantities, targets.parts)?;
            let mut first = 0;
            for (index, (modality, width)) in self.vectors_of.iter().copied().enumerate() {
                let value = match self.heads.get(&modality) {
                    Some(head) => {
                        let score = match targets.score {
                            Score::Loss => Head::losses,
                            Score::Intervals => Head::intervals,
                        };
                        score(head, &outputs, &predicted, &target, targets.parts)?
                    }
                    None => match self.own_loss(modality) {
                        Some(own_loss) => {
                            let columns = |of: &Tensor| of.narrow(1, first, width)?.contiguous();
                            let losses = own_loss(&columns(&predicted)?, &columns(&target)?)?;
                            losses.reshape((targets.parts, ()))?.mean(1)?
                        }
                        None => losses.get(index)?,
                    },
                };
                first += width;
                terms.push(Term { modality, value });
            }
        }
        if let Some(output) = &self.frames {
            for (index, &modality) in self.images_of.iter().enumerate() {
                let decoder = output.decoder(index * IMAGE_CHANNELS, IMAGE_CHANNELS)?;
                let target = targets.values.frames(&[modality])?;
                let rows = hidden.frames.dim(0)? / targets.parts;
                let of_part = |part: usize| {
                    let hidden = hidden.frames.narrow(0, part * rows, rows)?;
                    frame_loss(&hidden, decoder.clone(), frames::part(&target, part * rows, rows))
                };
                let losses = (0..targets.parts).map(of_part).collect::<Result<Vec<_>>>()?;
                terms.push(Term { modality, value: Tensor::stack(&losses, 0)? });
            }
        }
        Ok(terms)
    }

    fn detached(&self) -> Box<dyn Decoder> {
        let detached = |layers: &Option<Perceptron>| layers.as_ref().map(Perceptron::detached);
        Box::new(Self {
            condition: self.condition,
            vectors_of: self.vectors_of.clone(),
            heads: self.heads.clone(),
            categories: self.categories.clone(),
            unit_vectors: self.unit_vectors.clone(),
            images_of: self.images_of.clone(),
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
