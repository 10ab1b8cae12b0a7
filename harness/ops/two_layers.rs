//! Two fully connected layers with a ReLU between them, as one op.
//!
//! A network for vectors alone consists of two such pairs, and a training step takes a few milliseconds. Most of that
//! time goes to synchronizing threads and to passes over memory. Each thread therefore takes its rows of the batch
//! through both layers.

use super::{Arithmetic, TwoLayers, linear, slice, tensor, with_values};
use candle_core::{CpuStorage, CustomOp2, Layout, Result, Shape, Tensor};
use harness_kernels::product::{Accumulate, Matrix, product};
use harness_kernels::{self as kernels, Buffer};
use rayon::prelude::*;
use std::sync::OnceLock;

/// Number of parts that the batch is divided into. It is fixed, so that gradients are always summed in the same order.
/// Each part sums the weights' gradients on its own, so with a batch of a thousand more parts cost more than they gain.
const PARTS: usize = 4;

/// Returns `relu(x hidden_weightᵀ + hidden_bias) weightᵀ + bias`, `[batch, out]`, for `x` `[batch, in]`.
pub fn two_layers(x: &Tensor, layers: TwoLayers, arithmetic: Arithmetic) -> Result<Tensor> {
    let TwoLayers { hidden_weight, hidden_bias, weight, bias } = layers;
    if !x.device().is_cpu() {
        let hidden = linear(x, hidden_weight, hidden_bias, true, arithmetic)?;
        return linear(&hidden, weight, bias, false, arithmetic);
    }
    let ((hidden, inputs), outputs) = (hidden_weight.dims2()?, weight.dim(0)?);
    let sizes = LayerSizes { inputs, hidden, outputs, part: x.dim(0)?.div_ceil(PARTS), arithmetic };
    // candle gives an op at most three arguments, so all parameters are passed as one tensor and get one gradient.
    let flat = [hidden_weight, hidden_bias, weight, bias].map(Tensor::flatten_all);
    let packed = Tensor::cat(&flat.into_iter().collect::<Result<Vec<_>>>()?, 0)?;
    x.contiguous()?.apply_op2(&packed, Op { sizes, hidden: OnceLock::new() })
}

struct Op {
    sizes: LayerSizes,
    /// The hidden layer's output, `[batch, hidden]`, kept for the backward pass.
    hidden: OnceLock<Buffer>,
}

/// Sizes of the op's matrices.
#[derive(Clone, Copy)]
struct LayerSizes {
    inputs: usize,
    hidden: usize,
    outputs: usize,
    /// Rows in a part of the batch.
    part: usize,
    arithmetic: Arithmetic,
}

/// The parameters of both layers, or their gradients.
struct Unpacked<T> {
    hidden_weight: T,
    hidden_bias: T,
    weight: T,
    bias: T,
}

impl LayerSizes {
    fn unpack(self, packed: &[f32]) -> Unpacked<&[f32]> {
        let (hidden_weight, rest) = packed.split_at(self.hidden * self.inputs);
        let (hidden_bias, rest) = rest.split_at(self.hidden);
        let (weight, bias) = rest.split_at(self.outputs * self.hidden);
        Unpacked { hidden_weight, hidden_bias, weight, bias }
    }

    fn forward(self, x: &[f32], parameters: &Unpacked<&[f32]>, hidden: &mut [f32], y: &mut [f32]) {
        let Unpacked { hidden_weight, hidden_bias, weight, bias } = *parameters;
        let rows = x.len() / self.inputs;
        self.multiply(
            Matrix::plain(x, rows, self.inputs),
            Matrix::transposed(hidden_weight, self.hidden, self.inputs),
            hidden,
        );
        kernels::add_bias(hidden, hidden_bias, true);
        self.multiply(
            Matrix::plain(hidden, rows, self.hidden),
            Matrix::transposed(weight, self.outputs, self.hidden),
            y,
        );
        kernels::add_bias(y, bias, false);
    }

    /// Returns the gradient of the packed parameters for the rows `x`. `hidden` is the hidden layer's output for them,
    /// and `grad` is the gradient of their result. The gradient of `x` is written to `grad_x`, unless `grad_x` is
    /// empty.
    fn backward(
        self,
        x: &[f32],
        parameters: &Unpacked<&[f32]>,
        hidden: &[f32],
        grad: &[f32],
        grad_x: &mut [f32],
    ) -> Vec<f32> {
        let Unpacked { hidden_weight, weight, .. } = *parameters;
        let rows = x.len() / self.inputs;
        let mut grad_hidden = Buffer::new(rows * self.hidden);
        self.multiply(
            Matrix::plain(grad, rows, self.outputs),
            Matrix::plain(weight, self.outputs, self.hidden),
            &mut grad_hidden,
        );
        kernels::mask(&mut grad_hidden, hidden);
        let mut part = Unpacked {
            hidden_weight: kernels::scratch(self.hidden * self.inputs),
            hidden_bias: kernels::column_sums(&grad_hidden, self.hidden),
            weight: kernels::scratch(self.outputs * self.hidden),
            bias: kernels::column_sums(grad, self.outputs),
        };
        self.multiply(
            Matrix::transposed(grad, rows, self.outputs),
            Matrix::plain(hidden, rows, self.hidden),
            &mut part.weight,
        );
        self.multiply(
            Matrix::transposed(&grad_hidden, rows, self.hidden),
            Matrix::plain(x, rows, self.inputs),
            &mut part.hidden_weight,
        );
        if !grad_x.is_empty() {
            self.multiply(
                Matrix::plain(&grad_hidden, rows, self.hidden),
                Matrix::plain(hidden_weight, self.hidden, self.inputs),
                grad_x,
            );
        }
        [part.hidden_weight, part.hidden_bias, part.weight, part.bias].concat()
    }

    /// Computes a matrix product on the calling thread.
    fn multiply(self, a: Matrix, b: Matrix, out: &mut [f32]) {
        product(a, b, out, Accumulate::Overwrite, self.arithmetic, 1);
    }
}

impl CustomOp2 for Op {
    fn name(&self) -> &'static str {
        "two-layers"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        x_layout: &Layout,
        packed: &CpuStorage,
        packed_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let ((batch, _), sizes) = (x_layout.shape().dims2()?, self.sizes);
        let (x, parameters) = (slice(x, x_layout)?, sizes.unpack(slice(packed, packed_layout)?));
        let (mut hidden, mut y) =
            (Buffer::new(batch * sizes.hidden), kernels::scratch(batch * sizes.outputs));
        x.par_chunks(sizes.part * sizes.inputs)
            .zip(hidden.par_chunks_mut(sizes.part * sizes.hidden))
            .zip(y.par_chunks_mut(sizes.part * sizes.outputs))
            .for_each(|((x, hidden), y)| sizes.forward(x, &parameters, hidden, y));
        self.hidden.get_or_init(|| hidden);
        Ok((CpuStorage::F32(y), (batch, sizes.outputs).into()))
    }

    fn bwd(
        &self,
        x: &Tensor,
        packed: &Tensor,
        _y: &Tensor,
        grad: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let ((batch, inputs), sizes) = (x.dims2()?, self.sizes);
        let hidden = self.hidden.get().map(|hidden| &**hidden).unwrap_or_default();
        let mut grad_x = kernels::scratch(if x.track_op() { batch * inputs } else { 0 });
        let parts: Vec<Vec<f32>> = with_values(packed, |packed| {
            let parameters = sizes.unpack(packed);
            with_values(x, |x| {
                with_values(grad, |grad| {
                    // One slice for each part. The slices are empty if no gradient of `x` is needed.
                    let mut pieces: Vec<&mut [f32]> = grad_x.chunks_mut(sizes.part * inputs).collect();
                    pieces.resize_with(x.len().div_ceil(sizes.part * inputs), Default::default);
                    let parts = x
                        .par_chunks(sizes.part * inputs)
                        .zip(hidden.par_chunks(sizes.part * sizes.hidden))
                        .zip(grad.par_chunks(sizes.part * sizes.outputs))
                        .zip(pieces)
                        .map(|(((x, hidden), grad), grad_x)| {
                            sizes.backward(x, &parameters, hidden, grad, grad_x)
                        });
                    Ok(parts.collect())
                })
            })
        })?;
        let gradient = kernels::sum_in_order(parts, packed.elem_count());
        let grad_x = x.track_op().then(|| tensor(grad_x, (batch, inputs))).transpose()?;
        Ok((grad_x, Some(tensor(gradient, packed.shape())?)))
    }
}
