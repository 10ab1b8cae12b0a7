//! The layers of encoders and decoders.

use super::Parameters;
use super::description::{Activation, Convolution, IMAGES, Layer, Operation};
use crate::random::Random;
use candle_core::{DType, Device, Result, Tensor, Var};
use harness_ops::frames::{Averaged, Frames};
use harness_ops::{
    Arithmetic, Dropout, FrameDecoder, Stack, TwoLayers, frame_encoder, linear, norm, two_layers,
};
use std::sync::Arc;

/// Name of the layer that flattens the convolutions' output.
pub const FLAT: &str = "flat";
/// Added to the variance in layer normalization, so that the divisor is not zero.
const NORM_EPSILON: f32 = 1e-5;

/// Creates a network's parameters.
pub struct Builder<'a> {
    /// What is created for each parameter.
    pub made: Made<'a>,
    /// First part of the parameters' names: `encoder` or `decoder`.
    pub prefix: &'static str,
    /// How matrix products are computed.
    pub arithmetic: Arithmetic,
}

/// What is created for each parameter.
pub enum Made<'a> {
    /// A variable, which is added to `parameters`.
    Variables { parameters: &'a mut Parameters, random: &'a mut Random, device: &'a Device },
    /// A tensor of the same shape that takes no memory, for listing the layers.
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

    /// Creates a vector that is not trained.
    pub fn constant(&self, values: &[f32]) -> Result<Tensor> {
        let tensor = |device: &Device| Tensor::from_slice(values, values.len(), device);
        match &self.made {
            Made::Variables { device, .. } => tensor(device),
            Made::Shapes => tensor(&Device::Cpu),
        }
    }

    /// Creates a parameter with values uniform in ±1/√`fan_in`, PyTorch's default for linear and convolutional layers.
    pub fn uniform(&mut self, name: &str, shape: &[usize], fan_in: usize) -> Result<Tensor> {
        self.insert(name, shape, |random, len| random.uniform(len, 1.0 / (fan_in as f32).sqrt()))
    }

    /// Creates a fully connected layer.
    pub fn dense(&mut self, name: &str, inputs: usize, outputs: usize) -> Result<Dense> {
        Ok(Dense {
            weight: self.uniform(&format!("{name}.weight"), &[outputs, inputs], inputs)?,
            bias: self.uniform(&format!("{name}.bias"), &[outputs], inputs)?,
        })
    }

    /// Creates fully connected layers named `name`, `name2`, and so on. `widths` are the widths of the input and of
    /// each layer.
    pub fn perceptron(&mut self, name: &str, widths: &[usize]) -> Result<Perceptron> {
        let layers = widths.windows(2).enumerate().map(|(index, pair)| {
            let name = numbered(name, index);
            Ok((name.clone(), self.dense(&name, pair[0], pair[1])?))
        });
        Ok(Perceptron { layers: layers.collect::<Result<_>>()?, arithmetic: self.arithmetic })
    }

    /// Creates a layer normalization.
    pub fn norm(&mut self, name: &str, width: usize) -> Result<Norm> {
        Ok(Norm {
            weight: self.insert(&format!("{name}.weight"), &[width], |_, len| vec![1.0; len])?,
            bias: self.insert(&format!("{name}.bias"), &[width], |_, len| vec![0.0; len])?,
        })
    }

    /// Creates the convolutions of an encoder, or the `transposed` ones of a decoder, named `conv`, `conv2`, and so on.
    /// The first one takes or produces the frame.
    pub fn convolutions(&mut self, stack: &Stack, transposed: bool) -> Result<Vec<Dense>> {
        let layers = stack.layers().iter().enumerate().map(|(index, sizes)| {
            let (coarse, fine) = (sizes.coarse_channels, sizes.fine_channels);
            // PyTorch computes the fan-in of a transposed convolution from its output channels.
            let (name, fan_in) = (numbered("conv", index), fine * 16);
            let bias = if transposed { fine } else { coarse };
            Ok(Dense {
                weight: self.uniform(&format!("{name}.weight"), &[coarse, fine, 4, 4], fan_in)?,
                bias: self.uniform(&format!("{name}.bias"), &[bias], fan_in)?,
            })
        });
        layers.collect()
    }
}

/// Returns `name`, `name2`, `name3`, and so on, for `index` 0, 1, 2.
pub fn numbered(name: &str, index: usize) -> String {
    if index == 0 { name.to_owned() } else { format!("{name}{}", index + 1) }
}

/// Weight and bias of a fully connected layer or of a convolution.
pub struct Dense {
    /// `[outputs, inputs]`, or `[channels, channels before, 4, 4]` for a convolution.
    pub weight: Tensor,
    /// `[outputs]`, or one value a channel of the convolution's output.
    pub bias: Tensor,
}

impl Dense {
    /// Returns the same layer without gradients.
    pub fn detached(&self) -> Self {
        Self { weight: self.weight.detach(), bias: self.bias.detach() }
    }

    /// Returns `x weightᵀ + bias`, with a ReLU if `relu`.
    pub fn forward(&self, x: &Tensor, relu: bool, arithmetic: Arithmetic) -> Result<Tensor> {
        linear(x, &self.weight, &self.bias, relu, arithmetic)
    }

    /// Describes a fully connected layer.
    pub fn layer(&self, name: &str, input: &str, relu: bool) -> Result<Layer> {
        Ok(Layer {
            name: name.to_owned(),
            operation: Operation::Dense {
                weights: vec![format!("{name}.weight")],
                bias: format!("{name}.bias"),
                activation: Activation::relu_if(relu),
            },
            inputs: vec![input.to_owned()],
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
    /// Returns the same layers without gradients.
    pub fn detached(&self) -> Self {
        let layers = self.layers.iter().map(|(name, layer)| (name.clone(), layer.detached()));
        Self { layers: layers.collect(), arithmetic: self.arithmetic }
    }

    /// Returns a perceptron without layers.
    pub fn empty(arithmetic: Arithmetic) -> Self {
        Self { layers: Vec::new(), arithmetic }
    }

    /// Appends a layer.
    pub fn then(mut self, name: &str, layer: Dense) -> Self {
        self.layers.push((name.to_owned(), layer));
        self
    }

    /// Returns the parameters if there are two layers.
    pub fn two_layers(&self) -> Option<TwoLayers<'_>> {
        let [(_, hidden), (_, last)] = self.layers.as_slice() else { return None };
        Some(TwoLayers {
            hidden_weight: &hidden.weight,
            hidden_bias: &hidden.bias,
            weight: &last.weight,
            bias: &last.bias,
        })
    }

    /// Returns the last layer's output, with a ReLU if `relu`.
    pub fn forward(&self, x: &Tensor, relu: bool) -> Result<Tensor> {
        if let (Some(layers), false) = (self.two_layers(), relu) {
            return two_layers(x, layers, self.arithmetic);
        }
        let mut x = x.clone();
        for (index, (_, layer)) in self.layers.iter().enumerate() {
            x = layer.forward(&x, relu || index + 1 < self.layers.len(), self.arithmetic)?;
        }
        Ok(x)
    }

    /// Describes the layers, of which the first one takes `input`. The last one has a ReLU if `relu`.
    pub fn layers(&self, input: &str, relu: bool) -> Result<Vec<Layer>> {
        let inputs = std::iter::once(input).chain(self.layers.iter().map(|(name, _)| name.as_str()));
        let last = self.layers.len().saturating_sub(1);
        let layers = self.layers.iter().zip(inputs).enumerate();
        layers.map(|(index, ((name, layer), input))| layer.layer(name, input, relu || index < last)).collect()
    }
}

/// Layer normalization (Ba, Kiros & Hinton, 2016). Each row is normalized to mean 0 and variance 1. Each column is then
/// multiplied by its weight, and its bias is added.
pub struct Norm {
    weight: Tensor,
    bias: Tensor,
}

impl Norm {
    /// Returns the same layer without gradients.
    pub fn detached(&self) -> Self {
        Self { weight: self.weight.detach(), bias: self.bias.detach() }
    }

    /// Returns the normalized rows of `x` `[batch, width]`.
    pub fn forward(&self, x: &Tensor) -> Result<Tensor> {
        norm(x, &self.weight, &self.bias, NORM_EPSILON)
    }

    /// Describes the layer.
    pub fn layer(&self, name: &str, input: &str) -> Result<Layer> {
        let width = self.weight.dim(0)?;
        Ok(Layer {
            name: name.to_owned(),
            operation: Operation::LayerNormalization {
                weight: format!("{name}.weight"),
                bias: format!("{name}.bias"),
                epsilon: f64::from(NORM_EPSILON),
            },
            inputs: vec![input.to_owned()],
            output: vec![width],
            parameters: 2 * width,
        })
    }
}

/// Concatenates the parameters of convolutions and `last`, flattened.
fn pack<'a>(convolutions: impl Iterator<Item = &'a Dense>, last: Option<&Tensor>) -> Result<Tensor> {
    let tensors = convolutions.flat_map(|layer| [&layer.weight, &layer.bias]).chain(last);
    Tensor::cat(&tensors.map(Tensor::flatten_all).collect::<Result<Vec<_>>>()?, 0)
}

/// Appends the description of a layer that takes the output of the last one, or `input` if it is the first.
fn append(
    layers: &mut Vec<Layer>,
    input: &str,
    name: String,
    operation: Operation,
    output: Vec<usize>,
    of: &[&Tensor],
) {
    let input = layers.last().map_or(input, |layer| layer.name.as_str()).to_owned();
    let parameters = of.iter().map(|tensor| tensor.elem_count()).sum();
    layers.push(Layer { name, operation, inputs: vec![input], output, parameters });
}

/// Convolutions of frames, and the weight of the fully connected layer after them.
pub struct FrameInput {
    /// Sizes of the convolutions.
    pub stack: Stack,
    /// Frames are first averaged over squares with this side in pixels.
    pub average: usize,
    /// Kernels and biases of the convolutions.
    pub convolutions: Vec<Dense>,
    /// Weight of the fully connected layer, `[outputs, values of the last convolution]`.
    pub weight: Tensor,
    /// How matrix products are computed.
    pub arithmetic: Arithmetic,
}

impl FrameInput {
    /// Returns the same layers without gradients.
    pub fn detached(&self) -> Self {
        Self {
            stack: self.stack.clone(),
            average: self.average,
            convolutions: self.convolutions.iter().map(Dense::detached).collect(),
            weight: self.weight.detach(),
            arithmetic: self.arithmetic,
        }
    }

    /// Returns the output of the fully connected layer without its bias, `[batch, outputs]`.
    pub fn forward(&self, frames: &Arc<dyn Frames>, dropout: Option<Dropout>) -> Result<Tensor> {
        let frames = Averaged::over(frames.clone(), self.average);
        let packed = pack(self.convolutions.iter(), None)?;
        frame_encoder(frames, &self.stack, &packed, &self.weight, self.arithmetic, dropout)
    }

    /// Describes the layers before the fully connected one. The last of them is [`FLAT`].
    pub fn layers(&self) -> Vec<Layer> {
        let mut layers = Vec::new();
        if self.average > 1 {
            let first = &self.stack.layers()[0];
            let operation = Operation::Average { size: self.average };
            let output = vec![first.fine_channels, first.size[0], first.size[1]];
            append(&mut layers, IMAGES, "average".into(), operation, output, &[]);
        }
        for (index, (sizes, layer)) in self.stack.layers().iter().zip(&self.convolutions).enumerate() {
            let name = numbered("conv", index);
            let operation = Operation::Convolution(Convolution::new(&name, Activation::Relu));
            let [rows, columns] = sizes.coarse_size();
            let output = vec![sizes.coarse_channels, rows, columns];
            append(&mut layers, IMAGES, name, operation, output, &[&layer.weight, &layer.bias]);
        }
        append(&mut layers, IMAGES, FLAT.into(), Operation::Flatten, vec![self.stack.coarse_len()], &[]);
        layers
    }
}

/// A fully connected layer and transposed convolutions, which produce frames.
pub struct FrameOutput {
    /// Sizes of the convolutions.
    pub stack: Stack,
    /// Kernels and biases in the stack's order. The last one is applied first.
    pub convolutions: Vec<Dense>,
    /// The fully connected layer.
    pub dense: Dense,
    /// How matrix products are computed.
    pub arithmetic: Arithmetic,
}

impl FrameOutput {
    /// Returns the same layers without gradients.
    pub fn detached(&self) -> Self {
        Self {
            stack: self.stack.clone(),
            convolutions: self.convolutions.iter().map(Dense::detached).collect(),
            dense: self.dense.detached(),
            arithmetic: self.arithmetic,
        }
    }

    /// Returns the parameters that produce `channels` channels of the frames, starting at channel `first`.
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

    /// Describes the layers, of which the first one takes `input`.
    pub fn layers(&self, input: &str) -> Result<Vec<Layer>> {
        let mut layers = vec![self.dense.layer("frame", input, true)?];
        let stack = self.stack.layers();
        let last = &stack[stack.len() - 1];
        let [rows, columns] = last.coarse_size();
        let coarse = vec![last.coarse_channels, rows, columns];
        append(&mut layers, input, "coarse".into(), Operation::Reshape, coarse, &[]);
        for (index, (sizes, layer)) in stack.iter().zip(&self.convolutions).enumerate().rev() {
            let name = numbered("conv", index);
            let activation = Activation::relu_if(index > 0);
            let operation = Operation::TransposedConvolution(Convolution::new(&name, activation));
            let output = vec![sizes.fine_channels, sizes.size[0], sizes.size[1]];
            append(&mut layers, input, name, operation, output, &[&layer.weight, &layer.bias]);
        }
        Ok(layers)
    }
}
