//! The gates of a gated recurrent unit as one op.

use super::{slice, tensor, with_values};
use candle_core::{CpuStorage, CustomOp3, Layout, Result, Shape, Tensor, bail};
use candle_nn::ops::sigmoid;
use harness_kernels::{self as kernels, exp, simd};

/// Returns the next state of a gated recurrent unit, `[batch, width]` (Cho et al., 2014, in the form that PyTorch
/// computes): `n + z (state - n)` with the reset gate `r = σ(input_r + hidden_r)`, the update gate `z = σ(input_z +
/// hidden_z)` and the candidate `n = tanh(input_n + r hidden_n)`.
///
/// `input` and `hidden` are the products of the unit's input and of its last state with their weights, with biases:
/// `[batch, 3 * width]` each, the parts in the order r, z, n. `state` is the last state, `[batch, width]`.
///
/// # Errors
/// When the shapes do not match.
pub fn gru(input: &Tensor, hidden: &Tensor, state: &Tensor) -> Result<Tensor> {
    let (batch, width) = state.dims2()?;
    for gates in [input, hidden] {
        if gates.dims() != [batch, 3 * width] {
            bail!("the gates have the shape {:?} instead of {:?}", gates.dims(), [batch, 3 * width]);
        }
    }
    if state.device().is_cpu() {
        return input.contiguous()?.apply_op3(&hidden.contiguous()?, &state.contiguous()?, Gru);
    }
    let part = |gates: &Tensor, index: usize| gates.narrow(1, index * width, width);
    let reset = sigmoid(&(part(input, 0)? + part(hidden, 0)?)?)?;
    let update = sigmoid(&(part(input, 1)? + part(hidden, 1)?)?)?;
    let candidate = (part(input, 2)? + (reset * part(hidden, 2)?)?)?.tanh()?;
    &candidate + (update * (state - &candidate)?)?
}

struct Gru;

/// The gates of one unit.
struct Gates {
    reset: f32,
    update: f32,
    candidate: f32,
}

impl Gates {
    /// Computes the gates from the parts r, z and n of the input and of the hidden product.
    #[inline(always)]
    fn new(input: [f32; 3], hidden: [f32; 3]) -> Self {
        let logistic = |x: f32| 1.0 / (1.0 + exp(-x));
        let reset = logistic(input[0] + hidden[0]);
        let update = logistic(input[1] + hidden[1]);
        let candidate = 2.0 * logistic(2.0 * (input[2] + reset * hidden[2])) - 1.0;
        Self { reset, update, candidate }
    }
}

/// Returns the parts r, z and n of a row `[3 * width]`.
#[inline(always)]
fn parts(row: &[f32]) -> [&[f32]; 3] {
    let (reset, rest) = row.split_at(row.len() / 3);
    let (update, candidate) = rest.split_at(rest.len() / 2);
    [reset, update, candidate]
}

/// Returns the parts r, z and n of a row `[3 * width]`.
#[inline(always)]
fn parts_mut(row: &mut [f32]) -> [&mut [f32]; 3] {
    let (reset, rest) = row.split_at_mut(row.len() / 3);
    let (update, candidate) = rest.split_at_mut(rest.len() / 2);
    [reset, update, candidate]
}

impl CustomOp3 for Gru {
    fn name(&self) -> &'static str {
        "gru"
    }

    fn cpu_fwd(
        &self,
        input: &CpuStorage,
        input_layout: &Layout,
        hidden: &CpuStorage,
        hidden_layout: &Layout,
        state: &CpuStorage,
        state_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let (batch, width) = state_layout.shape().dims2()?;
        let mut next = kernels::scratch(batch * width);
        let rows = slice(input, input_layout)?.chunks_exact(3 * width);
        let rows = rows.zip(slice(hidden, hidden_layout)?.chunks_exact(3 * width));
        let rows = rows.zip(slice(state, state_layout)?.chunks_exact(width));
        simd(
            #[inline(always)]
            || {
                for (next, ((input, hidden), state)) in next.chunks_exact_mut(width).zip(rows) {
                    let ([ir, iz, i_n], [hr, hz, hn]) = (parts(input), parts(hidden));
                    for unit in 0..width {
                        let Gates { update, candidate, .. } =
                            Gates::new([ir[unit], iz[unit], i_n[unit]], [hr[unit], hz[unit], hn[unit]]);
                        next[unit] = candidate + update * (state[unit] - candidate);
                    }
                }
            },
        );
        Ok((CpuStorage::F32(next), (batch, width).into()))
    }

    fn bwd(
        &self,
        input: &Tensor,
        hidden: &Tensor,
        state: &Tensor,
        _next: &Tensor,
        grad: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let (batch, width) = state.dims2()?;
        let mut of_input = kernels::scratch(batch * 3 * width);
        let mut of_hidden = kernels::scratch(batch * 3 * width);
        let mut of_state = kernels::scratch(batch * width);
        with_values(input, |input| {
            with_values(hidden, |hidden| {
                with_values(state, |state| {
                    with_values(grad, |grad| {
                        let given = input.chunks_exact(3 * width).zip(hidden.chunks_exact(3 * width));
                        let given = given.zip(state.chunks_exact(width)).zip(grad.chunks_exact(width));
                        let wanted =
                            of_input.chunks_exact_mut(3 * width).zip(of_hidden.chunks_exact_mut(3 * width));
                        let wanted = wanted.zip(of_state.chunks_exact_mut(width));
                        simd(
                            #[inline(always)]
                            || {
                                for (((of_input, of_hidden), of_state), (((input, hidden), state), grad)) in
                                    wanted.zip(given)
                                {
                                    row_gradients(
                                        [parts(input), parts(hidden)],
                                        [state, grad],
                                        [parts_mut(of_input), parts_mut(of_hidden)],
                                        of_state,
                                    );
                                }
                            },
                        );
                        Ok(())
                    })
                })
            })
        })?;
        let gates = |values| tensor(values, (batch, 3 * width)).map(Some);
        Ok((gates(of_input)?, gates(of_hidden)?, Some(tensor(of_state, (batch, width))?)))
    }
}

/// Computes the gradients of one row from that of the next state.
#[inline(always)]
fn row_gradients(
    [[ir, iz, i_n], [hr, hz, hn]]: [[&[f32]; 3]; 2],
    [state, grad]: [&[f32]; 2],
    [[of_ir, of_iz, of_in], [of_hr, of_hz, of_hn]]: [[&mut [f32]; 3]; 2],
    of_state: &mut [f32],
) {
    for unit in 0..state.len() {
        let Gates { reset, update, candidate } =
            Gates::new([ir[unit], iz[unit], i_n[unit]], [hr[unit], hz[unit], hn[unit]]);
        // Gradients of the sums that the logistic functions and the hyperbolic tangent take.
        let of_candidate = grad[unit] * (1.0 - update) * (1.0 - candidate * candidate);
        let of_update = grad[unit] * (state[unit] - candidate) * update * (1.0 - update);
        let of_reset = of_candidate * hn[unit] * reset * (1.0 - reset);
        of_ir[unit] = of_reset;
        of_hr[unit] = of_reset;
        of_iz[unit] = of_update;
        of_hz[unit] = of_update;
        of_in[unit] = of_candidate;
        of_hn[unit] = of_candidate * reset;
        of_state[unit] = grad[unit] * update;
    }
}
