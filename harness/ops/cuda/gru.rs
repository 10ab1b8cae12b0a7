//! A gated recurrent unit over whole sequences.

use super::recurrent::{Recurrence, Weight, recur, weight_gradient};
use super::{Gpu, column_sums, not_on_cpu, slice, with_values};
use crate::{Arithmetic, Gated, linear};
use candle_core::cuda::cudarc::driver::CudaSlice;
use candle_core::{CudaStorage, CustomOp3, Layout, Result, Shape, Tensor, bail};
use std::sync::OnceLock;

/// The same as [`crate::gru`], on a GPU.
pub fn gru(
    inputs: &Tensor,
    input: Gated,
    hidden: Gated,
    start: &Tensor,
    arithmetic: Arithmetic,
) -> Result<Tensor> {
    let products = linear(inputs, input.weight, input.bias, false, arithmetic)?;
    let packed = Tensor::cat(&[&hidden.weight.flatten_all()?, hidden.bias], 0)?;
    products.apply_op3(&packed, &start.contiguous()?, Gru { arithmetic, gates: OnceLock::new() })
}

/// The arguments are the products with the inputs, `[times * batch, 3 * width]`, the weight and the bias of the product
/// with the last state, and the state before the first time.
struct Gru {
    arithmetic: Arithmetic,
    /// The gates and the candidate's product with the last state, `[times * batch, width, 4]`.
    gates: OnceLock<CudaSlice<f32>>,
}

impl CustomOp3 for Gru {
    fn name(&self) -> &'static str {
        "gru"
    }

    not_on_cpu!(CpuStorage, CpuStorage, CpuStorage);

    fn cuda_fwd(
        &self,
        products: &CudaStorage,
        products_layout: &Layout,
        packed: &CudaStorage,
        packed_layout: &Layout,
        start: &CudaStorage,
        start_layout: &Layout,
    ) -> Result<(CudaStorage, Shape)> {
        let ((rows, outputs), (batch, width)) =
            (products_layout.shape().dims2()?, start_layout.shape().dims2()?);
        let gpu = Gpu::with(products);
        let (products, packed, start) =
            (slice(products, products_layout)?, slice(packed, packed_layout)?, slice(start, start_layout)?);
        let (weight, bias) = packed.split_at(outputs * width);
        let (mut states, mut gates) = (gpu.scratch(rows * width)?, gpu.scratch(rows * 4 * width)?);
        let weights = [Weight { outputs: width, len: outputs }];
        let recurrence = Recurrence::new(&gpu, [batch, rows / batch], width, &weights)?;
        recur!(
            recurrence,
            "gru_forward",
            &(width as i32),
            &products,
            &weight,
            &bias,
            &start,
            &mut states,
            &mut gates
        );
        self.gates.get_or_init(|| gates);
        Ok(gpu.storage(states, (rows, width)))
    }

    fn bwd(
        &self,
        products: &Tensor,
        packed: &Tensor,
        start: &Tensor,
        states: &Tensor,
        grad: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let Some(gates) = self.gates.get() else { bail!("the unit has no gates to go back from") };
        let (gpu, (rows, outputs), (batch, width)) = (Gpu::of(products)?, products.dims2()?, start.dims2()?);
        let (mut of_input, mut of_hidden) = (gpu.scratch(rows * outputs)?, gpu.scratch(rows * outputs)?);
        let (mut of_packed, mut of_start) =
            (gpu.scratch(outputs * (width + 1))?, gpu.scratch(batch * width)?);
        let weights = [Weight { outputs: width, len: outputs }];
        let recurrence = Recurrence::new(&gpu, [batch, rows / batch], outputs, &weights)?;
        with_values(start, |start| {
            with_values(states, |states| {
                with_values(packed, |packed| {
                    with_values(grad, |grad| {
                        recur!(
                            recurrence,
                            "gru_backward",
                            &(width as i32),
                            gates,
                            &packed.slice(..outputs * width),
                            start,
                            states,
                            grad,
                            &mut of_input,
                            &mut of_hidden,
                            &mut of_start
                        );
                        Ok(())
                    })
                })?;
                let (of_hidden, mut of_weight) =
                    (of_hidden.as_view(), of_packed.slice_mut(..outputs * width));
                let (before, sizes) = ([start, states], [batch, width]);
                weight_gradient(&gpu, &of_hidden, before, &mut of_weight, sizes, self.arithmetic)
            })
        })?;
        let of_bias = column_sums(&gpu, &of_hidden.as_view(), outputs)?;
        gpu.0.memcpy_dtod(&of_bias, &mut of_packed.slice_mut(outputs * width..))?;
        Ok((
            Some(gpu.tensor(of_input, (rows, outputs))),
            Some(gpu.tensor(of_packed, packed.shape())),
            Some(gpu.tensor(of_start, (batch, width))),
        ))
    }
}
