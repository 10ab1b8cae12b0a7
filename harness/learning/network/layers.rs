//! The layers that encoders and decoders are made of.

use super::{LayerSummary, Parameters};
use crate::frames::{Averaged, Frames};
use crate::ops::{Arithmetic, Dropout, FrameDecoder, Stack, TwoLayers, frame_encoder, linear, two_layers};
use crate::random::Random;
use candle_core::{DType, Device, Result, Tensor, Var};
use std::sync::Arc;

/// Added to the variance that layer normalization divides by.
const NORM_EPSILON: f32 = 1e-5;

/// Makes a network's parameters.
pub struct Builder<'a> {
    pub made: Made<'a>,
    /// What names begin with: `encoder` or `decoder`.
    pub prefix: &'static str,
    pub arithmetic: Arithmetic,
}

/// What is made of each parameter.
pub enum Made<'a> {
    /// A variable that joins `parameters`.
    Variables { parameters: &'a mut Parameters, random: &'a mut Random, device: &'a Device },
    /// A tensor of its shape that takes no memory, for who wants to know the layers alone.
    Shapes,
}

impl Builder<'_> {
    fn insert(
        &mut self,
        name: &str,
        shape: &[usize],
        values: impl FnOnce(&mut Random, usize) -> Vec<f32>,
    ) -> Result<Tensor> {
        let Made::Variables { parameters, random, device } = &mut self.made else {
            return Tensor::zeros((), DType::F32, &Device::Cpu)?.broadcast_as(shape);
        };
        let values = values(random, shape.iter().product());
        let var = Var::from_tensor(&Tensor::from_vec(values, shape, device)?)?;
        let tensor = var.as_tensor().clone();
        parameters.insert(format!("{}.{name}", self.prefix), var);
        Ok(tensor)
    }

    /// A parameter, uniform in ±1/√`fan_in`: PyTorch's default for linear and convolutional layers.
    pub fn uniform(&mut self, name: &str, shape: &[usize], fan_in: usize) -> Result<Tensor> {
        self.insert(name, shape, |random, len| random.uniform(len, 1.0 / (fan_in as f32).sqrt()))
    }

    /// A fully connected layer.
    pub fn dense(&mut self, name: &str, inputs: usize, outputs: usize) -> Result<Dense> {
        Ok(Dense {
            weight: self.uniform(&format!("{name}.weight"), &[outputs, inputs], inputs)?,
            bias: self.uniform(&format!("{name}.bias"), &[outputs], inputs)?,
        })
    }

    /// Fully connected layers of the given widths, the first of which is that of the input, called `name`, `name2`, and
    /// so on.
    pub fn perceptron(&mut self, name: &str, widths: &[usize]) -> Result<Perceptron> {
        let layers = widths.windows(2).enumerate().map(|(index, pair)| {
            let name = numbered(name, index);
            Ok((name.clone(), self.dense(&name, pair[0], pair[1])?))
        });
        Ok(Perceptron { layers: layers.collect::<Result<_>>()?, arithmetic: self.arithmetic })
    }

    /// A layer normalization.
    pub fn norm(&mut self, name: &str, width: usize) -> Result<Norm> {
        Ok(Norm {
            weight: self.insert(&format!("{name}.weight"), &[width], |_, len| vec![1.0; len])?,
            bias: self.insert(&format!("{name}.bias"), &[width], |_, len| vec![0.0; len])?,
        })
    }

    /// Convolutions of an encoder, called `conv`, `conv2`, and so on.
    pub fn convolutions(&mut self, stack: &Stack) -> Result<Vec<Dense>> {
        let layers = stack.layers().iter().enumerate().map(|(index, sizes)| {
            let (coarse, fine) = (sizes.coarse_channels, sizes.fine_channels);
            self.convolution(index, [coarse, fine], coarse, fine)
        });
        layers.collect()
    }

    /// Transposed convolutions of a decoder, the one next to the frame first, called as the encoder's.
    pub fn transposed_convolutions(&mut self, stack: &Stack) -> Result<Vec<Dense>> {
        let layers = stack.layers().iter().enumerate().map(|(index, sizes)| {
            // A transposed convolution's fan-in, as PyTorch counts it, is taken over its output channels.
            let (coarse, fine) = (sizes.coarse_channels, sizes.fine_channels);
            self.convolution(index, [coarse, fine], fine, fine)
        });
        layers.collect()
    }

    fn convolution(
        &mut self,
        index: usize,
        channels: [usize; 2],
        bias: usize,
        fan_in: usize,
    ) -> Result<Dense> {
        let (name, fan_in) = (numbered("conv", index), fan_in * 16);
        Ok(Dense {
            weight: self.uniform(&format!("{name}.weight"), &[channels[0], channels[1], 4, 4], fan_in)?,
            bias: self.uniform(&format!("{name}.bias"), &[bias], fan_in)?,
        })
    }
}

/// `name`, `name2`, `name3`, and so on.
pub fn numbered(name: &str, index: usize) -> String {
    if index == 0 { name.to_owned() } else { format!("{name}{}", index + 1) }
}

/// Weight and bias of a fully connected layer or of a convolution.
pub struct Dense {
    pub weight: Tensor,
    pub bias: Tensor,
}

impl Dense {
    pub fn detached(&self) -> Self {
        Self { weight: self.weight.detach(), bias: self.bias.detach() }
    }

    /// `x weightᵀ + bias`, then ReLU if `relu`.
    pub fn forward(&self, x: &Tensor, relu: bool, arithmetic: Arithmetic) -> Result<Tensor> {
        linear(x, &self.weight, &self.bias, relu, arithmetic)
    }

    pub fn summary(&self, name: &str) -> Result<LayerSummary> {
        Ok(LayerSummary {
            name: name.to_owned(),
            output: vec![self.bias.dim(0)?],
            parameters: self.weight.elem_count() + self.bias.elem_count(),
        })
    }
}

/// Fully connected layers with a ReLU between each two.
pub struct Perceptron {
    layers: Vec<(String, Dense)>,
    arithmetic: Arithmetic,
}

impl Perceptron {
    pub fn detached(&self) -> Self {
        let layers = self.layers.iter().map(|(name, layer)| (name.clone(), layer.detached()));
        Self { layers: layers.collect(), arithmetic: self.arithmetic }
    }

    /// No layers yet.
    pub fn empty(arithmetic: Arithmetic) -> Self {
        Self { layers: Vec::new(), arithmetic }
    }

    /// Appends a layer.
    pub fn then(mut self, name: &str, layer: Dense) -> Self {
        self.layers.push((name.to_owned(), layer));
        self
    }

    /// The last layer's output, with a ReLU if `relu`.
    pub fn forward(&self, x: &Tensor, relu: bool) -> Result<Tensor> {
        if let ([(_, hidden), (_, last)], false) = (self.layers.as_slice(), relu) {
            let layers = TwoLayers {
                hidden_weight: &hidden.weight,
                hidden_bias: &hidden.bias,
                weight: &last.weight,
                bias: &last.bias,
            };
            return two_layers(x, layers, self.arithmetic);
        }
        let mut x = x.clone();
        for (index, (_, layer)) in self.layers.iter().enumerate() {
            x = layer.forward(&x, relu || index + 1 < self.layers.len(), self.arithmetic)?;
        }
        Ok(x)
    }

    pub fn summary(&self) -> Result<Vec<LayerSummary>> {
        self.layers.iter().map(|(name, layer)| layer.summary(name)).collect()
    }
}

/// Layer normalization (Ba, Kiros & Hinton, 2016): each row to mean 0 and variance 1, then a factor and a bias a column.
pub struct Norm {
    weight: Tensor,
    bias: Tensor,
}

impl Norm {
    pub fn detached(&self) -> Self {
        Self { weight: self.weight.detach(), bias: self.bias.detach() }
    }

    pub fn forward(&self, x: &Tensor) -> Result<Tensor> {
        // The other form in candle-nn has no gradient.
        candle_nn::ops::layer_norm_slow(x, &self.weight, &self.bias, NORM_EPSILON)
    }

    pub fn summary(&self, name: &str) -> Result<LayerSummary> {
        let width = self.weight.dim(0)?;
        Ok(LayerSummary { name: name.to_owned(), output: vec![width], parameters: 2 * width })
    }
}

/// The parameters of convolutions, one after the other.
fn pack<'a>(convolutions: impl Iterator<Item = &'a Dense>, last: Option<&Tensor>) -> Result<Tensor> {
    let tensors = convolutions.flat_map(|layer| [&layer.weight, &layer.bias]).chain(last);
    Tensor::cat(&tensors.map(Tensor::flatten_all).collect::<Result<Vec<_>>>()?, 0)
}

/// Names of the convolutions, their output and their parameters, by the side that `coarse` says.
fn convolution_summaries(stack: &Stack, layers: &[Dense], coarse: bool) -> Vec<LayerSummary> {
    let of = stack.layers().iter().zip(layers).enumerate().map(|(index, (sizes, layer))| LayerSummary {
        name: numbered("conv", index),
        output: if coarse {
            vec![sizes.coarse_channels, sizes.coarse_side(), sizes.coarse_side()]
        } else {
            vec![sizes.fine_channels, sizes.side, sizes.side]
        },
        parameters: layer.weight.elem_count() + layer.bias.elem_count(),
    });
    of.collect()
}

/// Convolutions of frames, and the product of the fully connected layer behind them.
pub struct FrameInput {
    pub stack: Stack,
    /// Frames are averaged over squares of so many pixels first.
    pub average: usize,
    pub convolutions: Vec<Dense>,
    /// `[outputs, values of the last convolution]`.
    pub weight: Tensor,
    pub arithmetic: Arithmetic,
}

impl FrameInput {
    pub fn detached(&self) -> Self {
        Self {
            stack: self.stack.clone(),
            average: self.average,
            convolutions: self.convolutions.iter().map(Dense::detached).collect(),
            weight: self.weight.detach(),
            arithmetic: self.arithmetic,
        }
    }

    /// The product, without a bias: `[batch, outputs]`.
    pub fn forward(&self, frames: &Arc<dyn Frames>, dropout: Option<Dropout>) -> Result<Tensor> {
        let frames = Averaged::over(frames.clone(), self.average);
        let packed = pack(self.convolutions.iter(), None)?;
        frame_encoder(frames, &self.stack, &packed, &self.weight, self.arithmetic, dropout)
    }

    pub fn summary(&self) -> Vec<LayerSummary> {
        convolution_summaries(&self.stack, &self.convolutions, true)
    }
}

/// A fully connected layer and transposed convolutions to frames.
pub struct FrameOutput {
    pub stack: Stack,
    /// Those of the stack, in its order: the last one is applied first.
    pub convolutions: Vec<Dense>,
    pub dense: Dense,
    pub arithmetic: Arithmetic,
}

impl FrameOutput {
    pub fn detached(&self) -> Self {
        Self {
            stack: self.stack.clone(),
            convolutions: self.convolutions.iter().map(Dense::detached).collect(),
            dense: self.dense.detached(),
            arithmetic: self.arithmetic,
        }
    }

    /// The way from the hidden layer to `channels` channels of the frames, from `first` on.
    pub fn decoder(&self, first: usize, channels: usize) -> Result<FrameDecoder> {
        let (frame, others) = self.convolutions.split_first().expect("a stack has a convolution");
        let frame = Dense {
            weight: frame.weight.narrow(1, first, channels)?,
            bias: frame.bias.narrow(0, first, channels)?,
        };
        let packed = pack(std::iter::once(&frame).chain(others), Some(&self.dense.bias))?;
        let stack = self.stack.with_frame_channels(channels);
        Ok(FrameDecoder { stack, weight: self.dense.weight.clone(), packed, arithmetic: self.arithmetic })
    }

    pub fn summary(&self) -> Result<Vec<LayerSummary>> {
        let mut layers = vec![self.dense.summary("frame")?];
        layers.extend(convolution_summaries(&self.stack, &self.convolutions, false).into_iter().rev());
        Ok(layers)
    }
}
