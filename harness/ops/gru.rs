//! A gated recurrent unit over whole sequences as one op.
//!
//! A step of the unit is a small matrix product. An op for each step, and its gradient, would cost more than the
//! products. Here the product with the inputs of all steps is computed at once, and the gradients of the weights are
//! products over all steps at once. The weight of the product with the last state is packed once for all steps, and
//! each thread takes its sequences through all of them, so that threads do not wait for each other at each step.

use super::linear::weight_gradient;
use super::{Arithmetic, Gated, slice, tensor, threads, with_values};
use candle_core::{CpuStorage, CustomOp3, Layout, Result, Shape, Tensor, bail};
use harness_kernels::product::{Accumulate, Matrix, product};
use harness_kernels::repeated::Repeated;
use harness_kernels::{self as kernels, Buffer, exp, simd};
use rayon::prelude::*;
use std::sync::OnceLock;

/// Returns the states of a gated recurrent unit over sequences, `[times * batch, width]` (Cho et al., 2014, in the form
/// that PyTorch computes). Each is `n + z (state - n)`, where `state` is the one before it. The reset gate is `r =
/// σ(input_r + hidden_r)`, the update gate `z = σ(input_z + hidden_z)`, and the candidate `n = tanh(input_n + r
/// hidden_n)`. Here `input` is the product of the unit's inputs with their weight, and `hidden` that of the last state.
///
/// `inputs` are `[times * batch, columns]`. The rows of one time lie together. `start` is the state before the first
/// time, `[batch, width]`.
pub fn gru(
    inputs: &Tensor,
    input: Gated,
    hidden: Gated,
    start: &Tensor,
    arithmetic: Arithmetic,
) -> Result<Tensor> {
    let ((rows, columns), (batch, width)) = (inputs.dims2()?, start.dims2()?);
    let fits = |gated: &Gated, columns: usize| {
        gated.weight.dims() == [3 * width, columns] && gated.bias.dims() == [3 * width]
    };
    if !fits(&input, columns) || !fits(&hidden, width) || batch == 0 || rows == 0 || rows % batch != 0 {
        let shapes = [inputs, input.weight, input.bias, hidden.weight, hidden.bias, start].map(Tensor::dims);
        bail!(
            "the inputs, the weights and biases of input and state, and the start have the shapes {shapes:?}"
        );
    }
    #[cfg(feature = "cuda")]
    if start.device().is_cuda() {
        return crate::cuda::gru(inputs, input, hidden, start, arithmetic);
    }
    // candle gives an op at most three arguments, so the parameters are passed as one tensor.
    let flat = [&input.weight.flatten_all()?, input.bias, &hidden.weight.flatten_all()?, hidden.bias];
    let op = Gru { sizes: Sizes { batch, columns, width, arithmetic }, products: OnceLock::new() };
    inputs.contiguous()?.apply_op3(&Tensor::cat(&flat, 0)?, &start.contiguous()?, op)
}

struct Gru {
    sizes: Sizes,
    /// Kept for the backward pass.
    products: OnceLock<Products>,
}

/// The products with the inputs and with the last states, or their gradients: `[times * batch, 3 * width]` each.
struct Products {
    input: Buffer,
    hidden: Buffer,
}

impl Products {
    /// Memory for products of so many rows, with arbitrary values.
    fn new(rows: usize, width: usize) -> Self {
        Self { input: Buffer::new(rows * 3 * width), hidden: Buffer::new(rows * 3 * width) }
    }
}

/// Sizes of the op's matrices.
#[derive(Clone, Copy)]
struct Sizes {
    /// Number of sequences.
    batch: usize,
    /// Number of inputs of the unit.
    columns: usize,
    /// Width of a state.
    width: usize,
    arithmetic: Arithmetic,
}

/// The division of sequences into parts, each of which one thread takes through all times. Values are
/// `[times * batch, columns]`, the rows of one time together.
#[derive(Clone, Copy)]
pub(super) struct Parts {
    /// Number of sequences.
    batch: usize,
    /// Number of sequences in a part; the last one may have fewer.
    pub rows: usize,
}

impl Parts {
    /// Returns the division of `batch` sequences for a product at each time.
    pub fn new(batch: usize, recurrent: &Repeated) -> Self {
        Self { batch, rows: batch.div_ceil(recurrent.parts(threads()).min(batch)) }
    }

    /// Returns the values of a part at one time.
    pub fn of(self, values: &[f32], columns: usize, part: usize, time: usize) -> &[f32] {
        let first = part * self.rows;
        let last = self.batch.min(first + self.rows);
        &values[(time * self.batch + first) * columns..(time * self.batch + last) * columns]
    }

    /// Returns the values of each part at each time, for several matrices with their numbers of columns.
    pub fn of_mut<const N: usize>(self, matrices: [(&mut [f32], usize); N]) -> Vec<Vec<[&mut [f32]; N]>> {
        let mut parts: Vec<_> = (0..self.batch.div_ceil(self.rows)).map(|_| Vec::new()).collect();
        let mut times = matrices.map(|(values, columns)| {
            let times = values.chunks_exact_mut(self.batch * columns);
            times.map(move |time| time.chunks_mut(self.rows * columns))
        });
        while let Some(mut time) = all(times.each_mut().map(Iterator::next)) {
            for part in &mut parts {
                part.extend(all(time.each_mut().map(Iterator::next)));
            }
        }
        parts
    }
}

/// Returns the values if there are all.
fn all<T, const N: usize>(values: [Option<T>; N]) -> Option<[T; N]> {
    let values: Vec<T> = values.into_iter().flatten().collect();
    values.try_into().ok()
}

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

impl Sizes {
    /// Number of values in the states of one time.
    fn state(self) -> usize {
        self.batch * self.width
    }

    /// Number of values in the weight and the bias of the product with the inputs. Those of the other product follow.
    fn input_len(self) -> usize {
        3 * self.width * (self.columns + 1)
    }

    /// Returns the weight and the bias of the product with the inputs, and those of the product with the last state.
    fn unpack(self, packed: &[f32]) -> [(&[f32], &[f32]); 2] {
        let (input, hidden) = packed.split_at(self.input_len());
        [input.split_at(3 * self.width * self.columns), hidden.split_at(3 * self.width * self.width)]
    }

    /// Computes the states of all times, `[times * batch, width]`, and the products that they are computed from.
    fn forward(
        self,
        inputs: &[f32],
        packed: &[f32],
        start: &[f32],
        products: &mut Products,
        states: &mut [f32],
    ) {
        let (width, gates, Products { input, hidden }) = (self.width, 3 * self.width, products);
        let [(input_weight, input_bias), (hidden_weight, hidden_bias)] = self.unpack(packed);
        let rows = Matrix::plain(inputs, inputs.len() / self.columns, self.columns);
        let weight = Matrix::transposed(input_weight, gates, self.columns);
        product(rows, weight, input, Accumulate::Overwrite, self.arithmetic, threads());
        kernels::add_bias(input, input_bias, false);

        let weight = Matrix::transposed(hidden_weight, gates, width);
        let recurrent = Repeated::new(weight, states.len() / self.state(), self.arithmetic);
        let parts = Parts::new(self.batch, &recurrent);
        let of_parts = parts.of_mut([(&mut *hidden, gates), (states, width)]).into_par_iter();
        of_parts.enumerate().for_each(|(part, times)| {
            let mut last = parts.of(start, width, part, 0);
            for (time, [hidden, states]) in times.into_iter().enumerate() {
                fill_rows(hidden, hidden_bias);
                recurrent.add_product(last, hidden, threads());
                next_states([parts.of(input, gates, part, time), hidden, last], states, width);
                last = states;
            }
        });
    }

    /// Computes the gradients of the products and of the first state. `last` are the states before each time, and
    /// `grad` is the gradient of all states.
    fn backward(
        self,
        given: &Products,
        last: &[f32],
        hidden_weight: &[f32],
        grad: &[f32],
        of_products: &mut Products,
        of_start: &mut [f32],
    ) {
        let (width, gates) = (self.width, 3 * self.width);
        let weight = Matrix::plain(hidden_weight, gates, width);
        let recurrent = Repeated::new(weight, grad.len() / self.state(), self.arithmetic);
        let parts = Parts::new(self.batch, &recurrent);
        let of_gates = parts.of_mut([(&mut *of_products.input, gates), (&mut *of_products.hidden, gates)]);
        let of_parts = of_gates.into_par_iter().zip(of_start.par_chunks_mut(parts.rows * width));
        of_parts.enumerate().for_each(|(part, (times, of_state))| {
            for (time, [of_input, of_hidden]) in times.into_iter().enumerate().rev() {
                let of_time = |values| parts.of(values, gates, part, time);
                let given =
                    [of_time(&given.input), of_time(&given.hidden), parts.of(last, width, part, time)];
                kernels::add_to(of_state, parts.of(grad, width, part, time));
                gradients(given, [of_input, &mut *of_hidden], of_state, width);
                recurrent.add_product(of_hidden, of_state, threads());
            }
        });
    }

    /// Returns the gradients of the parameters, in one vector.
    fn parameter_gradients(self, of_products: &Products, inputs: &[f32], last: &[f32]) -> Vec<f32> {
        let (width, gates) = (self.width, 3 * self.width);
        let mut packed = kernels::scratch(self.input_len() + gates * (width + 1));
        let (of_input, of_hidden) = packed.split_at_mut(self.input_len());
        let sides = [
            (&of_products.input, inputs, self.columns, of_input),
            (&of_products.hidden, last, width, of_hidden),
        ];
        for (of_gates, values, columns, wanted) in sides {
            let (of_weight, of_bias) = wanted.split_at_mut(gates * columns);
            weight_gradient(of_gates, values, [gates, columns], of_weight, self.arithmetic);
            of_bias.copy_from_slice(&kernels::column_sums(of_gates, gates));
        }
        packed
    }
}

impl CustomOp3 for Gru {
    fn name(&self) -> &'static str {
        "gru"
    }

    fn cpu_fwd(
        &self,
        inputs: &CpuStorage,
        inputs_layout: &Layout,
        packed: &CpuStorage,
        packed_layout: &Layout,
        start: &CpuStorage,
        start_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let (rows, _) = inputs_layout.shape().dims2()?;
        let (inputs, packed, start) =
            (slice(inputs, inputs_layout)?, slice(packed, packed_layout)?, slice(start, start_layout)?);
        let width = self.sizes.width;
        let (mut states, mut products) = (kernels::scratch(rows * width), Products::new(rows, width));
        self.sizes.forward(inputs, packed, start, &mut products, &mut states);
        self.products.get_or_init(|| products);
        Ok((CpuStorage::F32(states), (rows, width).into()))
    }

    fn bwd(
        &self,
        inputs: &Tensor,
        packed: &Tensor,
        start: &Tensor,
        states: &Tensor,
        grad: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let (sizes, rows) = (self.sizes, inputs.dim(0)?);
        let Sizes { batch, columns, width, arithmetic } = sizes;
        let Some(products) = self.products.get() else { bail!("the unit has no products to go back from") };
        // The state before each time.
        let last = Tensor::cat(&[start, &states.narrow(0, 0, rows - batch)?], 0)?;
        let (mut of_products, mut of_start) = (Products::new(rows, width), vec![0.0; sizes.state()]);
        let of_packed = with_values(&last, |last| {
            with_values(grad, |grad| {
                with_values(packed, |packed| {
                    let [_, (weight, _)] = sizes.unpack(packed);
                    sizes.backward(products, last, weight, grad, &mut of_products, &mut of_start);
                    Ok(())
                })
            })?;
            with_values(inputs, |inputs| Ok(sizes.parameter_gradients(&of_products, inputs, last)))
        })?;
        let of_inputs = inputs.track_op().then(|| {
            let mut of_inputs = kernels::scratch(rows * columns);
            with_values(packed, |packed| {
                let [(weight, _), _] = sizes.unpack(packed);
                let weight = Matrix::plain(weight, 3 * width, columns);
                let of_gates = Matrix::plain(&of_products.input, rows, 3 * width);
                product(of_gates, weight, &mut of_inputs, Accumulate::Overwrite, arithmetic, threads());
                Ok(())
            })?;
            tensor(of_inputs, (rows, columns))
        });
        let of_packed = tensor(of_packed, packed.shape())?;
        Ok((of_inputs.transpose()?, Some(of_packed), Some(tensor(of_start, (batch, width))?)))
    }
}

/// Sets each row to `values`.
pub(super) fn fill_rows(rows: &mut [f32], values: &[f32]) {
    rows.chunks_exact_mut(values.len()).for_each(|row| row.copy_from_slice(values));
}

/// Computes the states of one time from those before it, and from the products with the inputs and with those states.
pub(super) fn next_states([input, hidden, last]: [&[f32]; 3], states: &mut [f32], width: usize) {
    let rows = input.chunks_exact(3 * width).zip(hidden.chunks_exact(3 * width));
    let rows = rows.zip(last.chunks_exact(width)).zip(states.chunks_exact_mut(width));
    simd(
        #[inline(always)]
        || {
            for (((input, hidden), last), state) in rows {
                next_state(parts(input), parts(hidden), last, state);
            }
        },
    );
}

/// Computes the gradients of the two products of [`next_states`]. `grad` is the gradient of the states, and is replaced
/// by the part of the last states' gradient that does not pass through the product with them.
pub(super) fn gradients(
    [input, hidden, last]: [&[f32]; 3],
    [of_input, of_hidden]: [&mut [f32]; 2],
    grad: &mut [f32],
    width: usize,
) {
    let given = input.chunks_exact(3 * width).zip(hidden.chunks_exact(3 * width));
    let wanted = of_input.chunks_exact_mut(3 * width).zip(of_hidden.chunks_exact_mut(3 * width));
    let rows = given.zip(last.chunks_exact(width)).zip(wanted.zip(grad.chunks_exact_mut(width)));
    simd(
        #[inline(always)]
        || {
            for (((input, hidden), last), ((of_input, of_hidden), grad)) in rows {
                let wanted = [parts_mut(of_input), parts_mut(of_hidden)];
                row_gradients([parts(input), parts(hidden)], last, wanted, grad);
            }
        },
    );
}

/// Number of units that are computed at once: those of the widest vectors.
const LANES: usize = 16;
/// Values of units that are computed at once. They overlap with nothing, so the compiler vectorizes loops over them.
type Lanes = [f32; LANES];

/// Replaces the values of `wanted` by what `of_lanes` returns for the values of `given` and `wanted` at the same
/// places. All have the same length. Past the end, `of_lanes` gets zeros.
#[inline(always)]
fn by_lanes<const GIVEN: usize, const WANTED: usize>(
    given: [&[f32]; GIVEN],
    mut wanted: [&mut [f32]; WANTED],
    of_lanes: impl Fn([Lanes; GIVEN], [Lanes; WANTED]) -> [Lanes; WANTED],
) {
    let width = given.first().map_or(0, |values| values.len());
    for first in (0..width).step_by(LANES) {
        let (mut of_given, mut of_wanted) = ([[0.0; LANES]; GIVEN], [[0.0; LANES]; WANTED]);
        for (lanes, values) in of_given.iter_mut().zip(given) {
            *lanes = read(values, first);
        }
        for (lanes, values) in of_wanted.iter_mut().zip(&wanted) {
            *lanes = read(values, first);
        }
        let lanes = of_lanes(of_given, of_wanted);
        for (values, lanes) in wanted.iter_mut().zip(lanes) {
            write(values, first, lanes);
        }
    }
}

/// Returns the values from `first` on, and zeros past the end.
#[inline(always)]
fn read(values: &[f32], first: usize) -> Lanes {
    match values[first..].first_chunk() {
        Some(lanes) => *lanes,
        None => std::array::from_fn(|lane| values.get(first + lane).copied().unwrap_or_default()),
    }
}

/// Writes the values from `first` on, except those past the end.
#[inline(always)]
fn write(values: &mut [f32], first: usize, lanes: Lanes) {
    match values[first..].first_chunk_mut() {
        Some(chunk) => *chunk = lanes,
        None => values[first..].iter_mut().zip(lanes).for_each(|(value, lane)| *value = lane),
    }
}

/// Computes the state of one sequence from the one before it.
#[inline(always)]
fn next_state([ir, iz, i_n]: [&[f32]; 3], [hr, hz, hn]: [&[f32]; 3], last: &[f32], state: &mut [f32]) {
    by_lanes(
        [ir, iz, i_n, hr, hz, hn, last],
        [state],
        #[inline(always)]
        |[ir, iz, i_n, hr, hz, hn, last], _| {
            let mut next = [0.0; LANES];
            for lane in 0..LANES {
                let Gates { update, candidate, .. } =
                    Gates::new([ir[lane], iz[lane], i_n[lane]], [hr[lane], hz[lane], hn[lane]]);
                next[lane] = candidate + update * (last[lane] - candidate);
            }
            [next]
        },
    );
}

/// Computes the gradients of one row. `grad` is the gradient of the next state, and is replaced by the part of the last
/// state's gradient that does not pass through the hidden product.
#[inline(always)]
fn row_gradients(
    [[ir, iz, i_n], [hr, hz, hn]]: [[&[f32]; 3]; 2],
    last: &[f32],
    [[of_ir, of_iz, of_in], [of_hr, of_hz, of_hn]]: [[&mut [f32]; 3]; 2],
    grad: &mut [f32],
) {
    let given = [ir, iz, i_n, hr, hz, hn, last];
    let wanted = [of_ir, of_iz, of_in, of_hr, of_hz, of_hn, grad];
    by_lanes(
        given,
        wanted,
        #[inline(always)]
        |[ir, iz, i_n, hr, hz, hn, last], [.., next]| {
            // Gradients of the sums that the logistic functions and the hyperbolic tangent take.
            let [mut of_reset, mut of_update, mut of_candidate] = [[0.0; LANES]; 3];
            let [mut of_hidden, mut of_last] = [[0.0; LANES]; 2];
            for lane in 0..LANES {
                let Gates { reset, update, candidate } =
                    Gates::new([ir[lane], iz[lane], i_n[lane]], [hr[lane], hz[lane], hn[lane]]);
                of_candidate[lane] = next[lane] * (1.0 - update) * (1.0 - candidate * candidate);
                of_update[lane] = next[lane] * (last[lane] - candidate) * update * (1.0 - update);
                of_reset[lane] = of_candidate[lane] * hn[lane] * reset * (1.0 - reset);
                of_hidden[lane] = of_candidate[lane] * reset;
                of_last[lane] = next[lane] * update;
            }
            [of_reset, of_update, of_candidate, of_reset, of_update, of_hidden, of_last]
        },
    );
}
