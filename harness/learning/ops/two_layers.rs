//! Two fully connected layers with a ReLU between them, as one op.
//!
//! For vectors alone a network is this twice over, and a step takes a millisecond or two: what counts is how often
//! threads meet and memory is passed. Here each thread takes rows of the batch through both layers.

use super::{hand_over, is_trained, linear, slice, tensor, with_values};
use crate::learning::kernels::product::{Into, Matrix, product};
use crate::learning::kernels::{self, Buffer};
use crate::spec::Precision;
use candle_core::{CpuStorage, CustomOp2, Layout, Result, Shape, Tensor};
use rayon::prelude::*;
use std::sync::OnceLock;

/// Parts of the batch: a fixed number, so that gradients are always summed in the same order. Each part sums the
/// weights' gradients by itself, so more of them cost more than they gain on a batch of a thousand.
const PARTS: usize = 4;

/// Weights and biases of both layers: `[hidden, in]`, `[hidden]`, `[out, hidden]`, `[out]`, variables or detached.
pub struct TwoLayers {
    pub hidden_weight: Tensor,
    pub hidden_bias: Tensor,
    pub weight: Tensor,
    pub bias: Tensor,
}

/// `relu(x hidden_weightᵀ + hidden_bias) weightᵀ + bias`: `x` `[batch, in]`, result `[batch, out]`.
pub fn two_layers(x: &Tensor, layers: TwoLayers) -> Result<Tensor> {
    if !x.device().is_cpu() {
        let hidden = linear(x, &layers.hidden_weight, &layers.hidden_bias, true)?;
        return linear(&hidden, &layers.weight, &layers.bias, false);
    }
    for weight in [&layers.hidden_weight, &layers.hidden_bias, &layers.weight] {
        is_trained(weight)?;
    }
    let bias = layers.bias.clone();
    x.contiguous()?.apply_op2(&bias, Op { layers, hidden: OnceLock::new() })
}

struct Op {
    layers: TwoLayers,
    /// The hidden layer's output `[batch, hidden]`, kept for the gradients.
    hidden: OnceLock<Buffer>,
}

/// Sizes of the op's matrices.
#[derive(Clone, Copy)]
struct Sizes {
    inputs: usize,
    hidden: usize,
    outputs: usize,
    /// Rows of a part.
    part: usize,
}

impl Op {
    fn sizes(&self, batch: usize) -> Result<Sizes> {
        let ((hidden, inputs), outputs) = (self.layers.hidden_weight.dims2()?, self.layers.weight.dim(0)?);
        Ok(Sizes { inputs, hidden, outputs, part: batch.div_ceil(PARTS) })
    }
}

/// What a part of the batch adds to the gradients.
struct Part {
    hidden_weight: Vec<f32>,
    hidden_bias: Vec<f32>,
    weight: Vec<f32>,
    bias: Vec<f32>,
}

impl Sizes {
    fn forward(self, x: &[f32], weights: [&[f32]; 4], hidden: &mut [f32], y: &mut [f32]) {
        let [hidden_weight, hidden_bias, weight, bias] = weights;
        let rows = x.len() / self.inputs;
        multiply(
            Matrix::plain(x, rows, self.inputs),
            Matrix::transposed(hidden_weight, self.hidden, self.inputs),
            hidden,
        );
        kernels::add_bias(hidden, hidden_bias, true);
        multiply(
            Matrix::plain(hidden, rows, self.hidden),
            Matrix::transposed(weight, self.outputs, self.hidden),
            y,
        );
        kernels::add_bias(y, bias, false);
    }

    /// Gradients for rows `x` with the hidden layer's output `hidden`, given those of the result; that of `x` goes to
    /// `grad_x` where one is wanted.
    fn backward(
        self,
        x: &[f32],
        weights: [&[f32]; 2],
        hidden: &[f32],
        grad: &[f32],
        grad_x: &mut [f32],
    ) -> Part {
        let [hidden_weight, weight] = weights;
        let rows = x.len() / self.inputs;
        let mut grad_hidden = Buffer::new(rows * self.hidden);
        multiply(
            Matrix::plain(grad, rows, self.outputs),
            Matrix::plain(weight, self.outputs, self.hidden),
            &mut grad_hidden,
        );
        kernels::mask(&mut grad_hidden, hidden);
        let mut part = Part {
            hidden_weight: kernels::scratch(self.hidden * self.inputs),
            hidden_bias: kernels::column_sums(&grad_hidden, self.hidden),
            weight: kernels::scratch(self.outputs * self.hidden),
            bias: kernels::column_sums(grad, self.outputs),
        };
        multiply(
            Matrix::transposed(grad, rows, self.outputs),
            Matrix::plain(hidden, rows, self.hidden),
            &mut part.weight,
        );
        multiply(
            Matrix::transposed(&grad_hidden, rows, self.hidden),
            Matrix::plain(x, rows, self.inputs),
            &mut part.hidden_weight,
        );
        if !grad_x.is_empty() {
            multiply(
                Matrix::plain(&grad_hidden, rows, self.hidden),
                Matrix::plain(hidden_weight, self.hidden, self.inputs),
                grad_x,
            );
        }
        part
    }
}

/// A product on this thread alone.
fn multiply(a: Matrix, b: Matrix, out: &mut [f32]) {
    product(a, b, out, Into::Overwrite, Precision::F32, 1);
}

impl CustomOp2 for Op {
    fn name(&self) -> &'static str {
        "two-layers"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        x_layout: &Layout,
        bias: &CpuStorage,
        bias_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let (batch, _) = x_layout.shape().dims2()?;
        let sizes = self.sizes(batch)?;
        let (x, bias) = (slice(x, x_layout)?, slice(bias, bias_layout)?);
        let (mut hidden, mut y) =
            (Buffer::new(batch * sizes.hidden), kernels::scratch(batch * sizes.outputs));
        let layers = &self.layers;
        with_values(&layers.hidden_weight, |hidden_weight| {
            with_values(&layers.hidden_bias, |hidden_bias| {
                with_values(&layers.weight, |weight| {
                    let weights = [hidden_weight, hidden_bias, weight, bias];
                    x.par_chunks(sizes.part * sizes.inputs)
                        .zip(hidden.par_chunks_mut(sizes.part * sizes.hidden))
                        .zip(y.par_chunks_mut(sizes.part * sizes.outputs))
                        .for_each(|((x, hidden), y)| sizes.forward(x, weights, hidden, y));
                    Ok(())
                })
            })
        })?;
        self.hidden.get_or_init(|| hidden);
        Ok((CpuStorage::F32(y), (batch, sizes.outputs).into()))
    }

    fn bwd(
        &self,
        x: &Tensor,
        _bias: &Tensor,
        _y: &Tensor,
        grad: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let (batch, inputs) = x.dims2()?;
        let sizes = self.sizes(batch)?;
        let hidden = self.hidden.get().map(|hidden| &**hidden).unwrap_or_default();
        let mut grad_x = kernels::scratch(if x.track_op() { batch * inputs } else { 0 });
        let layers = &self.layers;
        let parts: Vec<Part> = with_values(&layers.hidden_weight, |hidden_weight| {
            with_values(&layers.weight, |weight| {
                with_values(x, |x| {
                    with_values(grad, |grad| {
                        // One piece a part, empty where no gradient of `x` is wanted.
                        let mut pieces: Vec<&mut [f32]> = grad_x.chunks_mut(sizes.part * inputs).collect();
                        pieces.resize_with(x.len().div_ceil(sizes.part * inputs), Default::default);
                        let parts = x
                            .par_chunks(sizes.part * inputs)
                            .zip(hidden.par_chunks(sizes.part * sizes.hidden))
                            .zip(grad.par_chunks(sizes.part * sizes.outputs))
                            .zip(pieces)
                            .map(|(((x, hidden), grad), grad_x)| {
                                sizes.backward(x, [hidden_weight, weight], hidden, grad, grad_x)
                            });
                        Ok(parts.collect())
                    })
                })
            })
        })?;
        let mut sums: [Vec<Vec<f32>>; 4] = Default::default();
        for part in parts {
            let pieces = [part.hidden_weight, part.hidden_bias, part.weight, part.bias];
            sums.iter_mut().zip(pieces).for_each(|(sum, piece)| sum.push(piece));
        }
        let [hidden_weight, hidden_bias, weight, bias] = sums.map(|pieces| {
            let len = pieces.first().map_or(0, Vec::len);
            kernels::sum_in_order(pieces, len)
        });
        for (weight, gradient) in [
            (&layers.hidden_weight, hidden_weight),
            (&layers.hidden_bias, hidden_bias),
            (&layers.weight, weight),
        ] {
            if is_trained(weight)? {
                hand_over(weight, gradient)?;
            }
        }
        let grad_x = x.track_op().then(|| tensor(grad_x, (batch, inputs))).transpose()?;
        Ok((grad_x, Some(tensor(bias, sizes.outputs)?)))
    }
}
