//! Convolutions of 4 x 4 with a stride of 2, and their gradients.

use super::{Gpu, launch, write_column_sums};
use crate::Stack;
use crate::stack::Side;
use candle_core::Result;
use candle_core::cuda::cudarc::driver::{
    CudaSlice, CudaView, CudaViewMut, DevicePtr, DeviceRepr, LaunchConfig,
};
use harness_kernels::convolution::Convolution;

/// Number of threads in a block.
const THREADS: usize = 256;
/// Number of coarse channels that a thread of `kernel_gradient` sums.
const OUTPUTS: usize = 4;
/// The number of blocks that keep a GPU busy. With more, each block would sum less before it sums over its threads.
const BLOCKS: usize = 528;

#[repr(C)]
#[derive(Clone, Copy)]
struct Sizes {
    batch: i32,
    fine_channels: i32,
    coarse_channels: i32,
    rows: i32,
    columns: i32,
}
// SAFETY: the kernels declare the same fields.
unsafe impl DeviceRepr for Sizes {}

/// What follows a convolution: a bias is added if there is one, then negative values become 0 if `relu`, or values
/// become 0 where those of `mask` are not positive.
#[repr(C)]
#[derive(Clone, Copy, Default)]
pub struct Then {
    bias: u64,
    mask: u64,
    relu: i32,
}
// SAFETY: the kernels declare the same fields.
unsafe impl DeviceRepr for Then {}

impl Then {
    /// Adds a bias, with a ReLU after it if `relu`.
    pub fn bias(gpu: &Gpu, bias: &CudaView<f32>, relu: bool) -> Self {
        Self { bias: bias.device_ptr(&gpu.stream()).0, relu: i32::from(relu), ..Self::default() }
    }

    /// Sets values to zero where `output`, that of a ReLU, is not positive.
    pub fn mask(gpu: &Gpu, output: &CudaView<f32>) -> Self {
        Self { mask: output.device_ptr(&gpu.stream()).0, ..Self::default() }
    }
}

fn sizes(layer: &Convolution, batch: usize) -> Sizes {
    let [rows, columns] = layer.coarse_size();
    Sizes {
        batch: batch as i32,
        fine_channels: layer.fine_channels as i32,
        coarse_channels: layer.coarse_channels as i32,
        rows: rows as i32,
        columns: columns as i32,
    }
}

fn grid(positions: usize, rows: usize) -> LaunchConfig {
    LaunchConfig {
        grid_dim: (positions.div_ceil(THREADS) as u32, rows as u32, 1),
        block_dim: (THREADS as u32, 1, 1),
        shared_mem_bytes: 0,
    }
}

/// Returns the coarse images.
pub fn convolve(
    gpu: &Gpu,
    layer: &Convolution,
    batch: usize,
    fine: &CudaView<f32>,
    kernel: &CudaView<f32>,
    then: Then,
) -> Result<CudaSlice<f32>> {
    let ([rows, columns], sizes) = (layer.coarse_size(), sizes(layer, batch));
    let (positions, channels) = (batch * rows * columns.div_ceil(2), layer.coarse_channels);
    let mut coarse = gpu.scratch(batch * layer.coarse_len())?;
    if channels <= 4 {
        let config = grid(positions, 1);
        launch!(gpu, CONVOLUTION, "convolve_4", config, fine, kernel, &mut coarse, &sizes, &then);
    } else {
        let config = grid(positions, channels.div_ceil(8));
        launch!(gpu, CONVOLUTION, "convolve_8", config, fine, kernel, &mut coarse, &sizes, &then);
    }
    Ok(coarse)
}

/// Returns the fine images.
pub fn spread(
    gpu: &Gpu,
    layer: &Convolution,
    batch: usize,
    coarse: &CudaView<f32>,
    kernel: &CudaView<f32>,
    then: Then,
) -> Result<CudaSlice<f32>> {
    let ([rows, columns], sizes) = (layer.coarse_size(), sizes(layer, batch));
    let (positions, channels) = (batch * rows * columns.div_ceil(2), layer.fine_channels);
    let mut fine = gpu.scratch(batch * layer.fine_len())?;
    if channels <= 4 {
        let config = grid(positions, 1);
        launch!(gpu, CONVOLUTION, "spread_4", config, coarse, kernel, &mut fine, &sizes, &then);
    } else {
        let config = grid(positions, channels.div_ceil(8));
        launch!(gpu, CONVOLUTION, "spread_8", config, coarse, kernel, &mut fine, &sizes, &then);
    }
    Ok(fine)
}

/// Computes the gradient of a kernel. One of `fine` and `coarse` is the input, and the other one the gradient of the
/// output.
fn kernel_gradient(
    gpu: &Gpu,
    layer: &Convolution,
    batch: usize,
    fine: &CudaView<f32>,
    coarse: &CudaView<f32>,
    out: &mut CudaViewMut<f32>,
) -> Result<()> {
    let [rows, columns] = layer.coarse_size();
    let (positions, groups) =
        (batch * rows * columns.div_ceil(2), layer.fine_channels * layer.coarse_channels.div_ceil(OUTPUTS));
    let parts = positions.div_ceil(4 * THREADS).min(BLOCKS.div_ceil(groups)).max(1);
    let (len, sizes) = (layer.kernel_len(), sizes(layer, batch));
    let mut sums = gpu.scratch(parts * len)?;
    let config = LaunchConfig { grid_dim: (parts as u32, groups as u32, 1), ..grid(1, 1) };
    launch!(gpu, CONVOLUTION, "kernel_gradient", config, fine, coarse, &mut sums, &sizes);
    write_column_sums(gpu, &sums.as_view(), out)
}

/// Sums each channel over all images.
fn channel_sums(
    gpu: &Gpu,
    images: &CudaView<f32>,
    [batch, channels]: [usize; 2],
    out: &mut CudaViewMut<f32>,
) -> Result<()> {
    let area = images.len() / (batch * channels);
    let parts = BLOCKS.div_ceil(channels).min((batch * area).div_ceil(4 * THREADS)).min(batch);
    let mut sums = gpu.scratch(parts * channels)?;
    let config = LaunchConfig { grid_dim: (channels as u32, parts as u32, 1), ..grid(1, 1) };
    let (batch, channels, area) = (batch as i32, channels as i32, area as i32);
    launch!(gpu, CONVOLUTION, "channel_sums", config, images, &mut sums, &batch, &channels, &area);
    write_column_sums(gpu, &sums.as_view(), out)
}

/// Where the kernel and the bias of each layer lie in packed parameters.
pub struct Places(Vec<[usize; 3]>);

impl Places {
    /// Returns the places of an encoder's or of a decoder's parameters.
    pub fn of(stack: &Stack, side: Side) -> Self {
        let mut first = 0;
        let places = stack.layers().iter().map(|layer| {
            let bias = first + layer.kernel_len();
            let end = bias + side.channels(layer);
            [std::mem::replace(&mut first, end), bias, end]
        });
        Self(places.collect())
    }

    /// Returns a layer's kernel and bias.
    pub fn split<'a>(&self, packed: &CudaView<'a, f32>, layer: usize) -> [CudaView<'a, f32>; 2] {
        let [kernel, bias, end] = self.0[layer];
        [packed.slice(kernel..bias), packed.slice(bias..end)]
    }

    /// Returns the number of values of all layers.
    pub fn end(&self) -> usize {
        self.0.last().map_or(0, |place| place[2])
    }

    /// Computes the gradients of a layer's kernel and bias. `biased` are gradients of the images that the bias was
    /// added to, which are `fine` or `coarse`.
    pub fn gradients(
        &self,
        gpu: &Gpu,
        (index, layer): (usize, &Convolution),
        [fine, coarse, biased]: [&CudaView<f32>; 3],
        batch: usize,
        packed: &mut CudaSlice<f32>,
    ) -> Result<()> {
        let [kernel, bias, end] = self.0[index];
        kernel_gradient(gpu, layer, batch, fine, coarse, &mut packed.slice_mut(kernel..bias))?;
        channel_sums(gpu, biased, [batch, end - bias], &mut packed.slice_mut(bias..end))
    }
}
