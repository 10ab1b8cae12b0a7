//! The ops on a GPU, through CUDA.
//!
//! Each op has the same arguments, result and gradients as on the CPU. Its matrix products are computed by cuBLAS, and
//! the rest by the kernels in the `.cu` files beside this one. All work of a device is queued on its one stream, and no
//! op waits for it.

mod adam;
mod convolution;
mod frame_encoder;
mod frame_loss;
mod frames;
pub mod graph;
mod gru;
mod linear;
mod norm;
mod posterior;
mod recurrent;
mod rssm;
mod vector_losses;

pub use adam::{Slot, adam};
pub use frame_encoder::frame_encoder;
pub use frame_loss::{frame_decoder, frame_loss};
pub use frames::{FrameTable, gather};
pub use gru::gru;
pub use linear::linear;
pub use norm::norm;
pub use posterior::{balanced_divergence, kl_divergence, sample};
pub use rssm::rssm;
pub use vector_losses::vector_losses;

use super::Arithmetic;
use candle_core::backend::BackendStorage;
use candle_core::cuda::WrapErr;
use candle_core::cuda::cudarc::cublas::{result::gemm_ex, sys as cublas};
use candle_core::cuda::cudarc::driver::{
    CudaFunction, CudaSlice, CudaStream, CudaView, CudaViewMut, DevicePtr, DevicePtrMut, LaunchConfig,
};
use candle_core::cuda::cudarc::driver::{result as driver, sys::CUmemPool_attribute};
use candle_core::op::BackpropOp;
use candle_core::{CudaDevice, CudaStorage, DType, Device, Layout, Result, Shape, Storage, Tensor, bail};
use harness_kernels::product::Precision;
use std::ffi::c_void;
use std::sync::Arc;

/// The kernels as PTX, one constant for each `.cu` file.
mod ptx {
    include!(concat!(env!("OUT_DIR"), "/ptx.rs"));
}

/// The number of threads in a block of a kernel that treats each value by itself.
const BLOCK: usize = 256;

/// Launches a kernel: `launch!(gpu, FILE, "name", config, arguments)`. `FILE` is the `.cu` file in capitals. Slices are
/// passed by reference, and numbers as references to `i32`, `u32`, `u64` or `f32`.
macro_rules! launch {
    ($gpu:expr, $file:ident, $name:literal, $config:expr, $($argument:expr),+ $(,)?) => {{
        use candle_core::cuda::WrapErr;
        use candle_core::cuda::cudarc::driver::PushKernelArg;
        let function = $gpu.function(stringify!($file), $crate::cuda::ptx::$file, $name)?;
        // SAFETY: the arguments have the types that the kernel declares, and it reads and writes within their lengths.
        unsafe { $gpu.stream().launch_builder(&function)$(.arg($argument))+.launch($config) }.w()?;
    }};
}
use launch;

/// Defines the forward pass on the CPU, which a GPU op refuses: `not_on_cpu!(CpuStorage, CpuStorage)` for two arguments.
macro_rules! not_on_cpu {
    ($($storage:ident),+) => {
        fn cpu_fwd(
            &self,
            $(_: &candle_core::$storage, _: &candle_core::Layout),+
        ) -> candle_core::Result<(candle_core::CpuStorage, candle_core::Shape)> {
            candle_core::bail!("a GPU op was given a tensor of the CPU")
        }
    };
}
use not_on_cpu;

/// A GPU, on which memory is taken and kernels are launched.
#[derive(Clone)]
struct Gpu(CudaDevice);

impl Gpu {
    /// Returns the GPU that holds a tensor.
    fn of(tensor: &Tensor) -> Result<Self> {
        match tensor.device() {
            Device::Cuda(device) => Ok(Self(device.clone())),
            _ => bail!("a GPU op was given a tensor of another device"),
        }
    }

    /// Returns the GPU that holds the argument of an op.
    fn with(storage: &CudaStorage) -> Self {
        Self(storage.device().clone())
    }

    fn function(&self, file: &str, ptx: &str, name: &str) -> Result<CudaFunction> {
        Ok(self.0.get_or_load_custom_func(name, file, ptx)?.into_cuda_function())
    }

    fn stream(&self) -> Arc<CudaStream> {
        self.0.cuda_stream()
    }

    /// Returns memory with arbitrary values.
    fn scratch(&self, len: usize) -> Result<CudaSlice<f32>> {
        // SAFETY: callers write every value before they read it.
        unsafe { self.0.alloc(len) }
    }

    /// Returns a tensor of `values`, without a gradient.
    fn tensor(&self, values: CudaSlice<f32>, shape: impl Into<Shape>) -> Tensor {
        let storage = Storage::Cuda(CudaStorage::wrap_cuda_slice(values, self.0.clone()));
        Tensor::from_storage(storage, shape, BackpropOp::none(), false)
    }

    /// Returns the result of an op.
    fn storage(&self, values: CudaSlice<f32>, shape: impl Into<Shape>) -> (CudaStorage, Shape) {
        (CudaStorage::wrap_cuda_slice(values, self.0.clone()), shape.into())
    }

    /// Computes `out = a b`, or `out += a b` if `add`. With [`Precision::Tf32`], the factors are rounded to 10 bits.
    fn product(
        &self,
        a: Matrix,
        b: Matrix,
        out: &mut impl DevicePtrMut<f32>,
        add: bool,
        arithmetic: Arithmetic,
    ) -> Result<()> {
        let (m, k, n) = (a.rows, a.columns, b.columns);
        if b.rows != k || out.len() != m * n {
            bail!("a product of {m} x {k} and {} x {n} has {} values", b.rows, out.len());
        }
        let compute = match arithmetic.precision {
            Precision::Tf32 => cublas::cublasComputeType_t::CUBLAS_COMPUTE_32F_FAST_TF32,
            _ => cublas::cublasComputeType_t::CUBLAS_COMPUTE_32F,
        };
        let (one, added) = (1.0_f32, if add { 1.0_f32 } else { 0.0 });
        let (stream, blas, f32) =
            (self.0.cuda_stream(), self.0.cublas_handle(), cublas::cudaDataType::CUDA_R_32F);
        let ((a_values, _a), (b_values, _b)) = (a.values.device_ptr(&stream), b.values.device_ptr(&stream));
        let (out, _out) = out.device_ptr_mut(&stream);
        // cuBLAS stores matrices by column. A matrix that is stored by row is its transpose, so it computes the
        // transpose of the product.
        //
        // SAFETY: the lengths of all three matrices were compared with their sizes, and `out` is borrowed mutably.
        unsafe {
            gemm_ex(
                *blas.handle(),
                b.operation(),
                a.operation(),
                n as i32,
                m as i32,
                k as i32,
                (&raw const one).cast(),
                b_values as *const c_void,
                f32,
                b.stride() as i32,
                a_values as *const c_void,
                f32,
                a.stride() as i32,
                (&raw const added).cast(),
                out as *mut c_void,
                f32,
                n as i32,
                compute,
                cublas::cublasGemmAlgo_t::CUBLAS_GEMM_DEFAULT,
            )
        }
        .w()
    }
}

/// A factor of a product.
#[derive(Clone, Copy)]
struct Matrix<'a> {
    values: &'a CudaView<'a, f32>,
    rows: usize,
    columns: usize,
    transposed: bool,
}

impl<'a> Matrix<'a> {
    /// A matrix whose values are stored row by row.
    fn plain(values: &'a CudaView<'a, f32>, rows: usize, columns: usize) -> Self {
        assert_eq!(values.len(), rows * columns, "values of a matrix");
        Self { values, rows, columns, transposed: false }
    }

    /// The transpose of a matrix of `rows` rows, whose values are stored row by row.
    fn transposed(values: &'a CudaView<'a, f32>, rows: usize, columns: usize) -> Self {
        assert_eq!(values.len(), rows * columns, "values of a matrix");
        Self { values, rows: columns, columns: rows, transposed: true }
    }

    fn operation(&self) -> cublas::cublasOperation_t {
        if self.transposed {
            cublas::cublasOperation_t::CUBLAS_OP_T
        } else {
            cublas::cublasOperation_t::CUBLAS_OP_N
        }
    }

    /// Returns the distance between two stored rows.
    fn stride(&self) -> usize {
        if self.transposed { self.rows } else { self.columns }
    }
}

/// Opens the first GPU, with a stream of its own.
pub fn open() -> Result<Device> {
    let device = Device::new_cuda_with_stream(0)?;
    if let Device::Cuda(device) = &device {
        // SAFETY: all tensors of this device are made, used and freed on its one stream, which keeps their order.
        unsafe { device.disable_event_tracking() };
        keep_memory(&device.cuda_stream())?;
    }
    Ok(device)
}

/// Lets the driver keep freed memory for the next tensors. By default, it returns the memory at each synchronization.
fn keep_memory(stream: &CudaStream) -> Result<()> {
    let mut most = u64::MAX;
    // SAFETY: the device exists, and the attribute is a 64-bit number.
    unsafe {
        let pool = driver::device::get_default_mem_pool(stream.context().cu_device()).w()?;
        let attribute = CUmemPool_attribute::CU_MEMPOOL_ATTR_RELEASE_THRESHOLD;
        driver::mem_pool::set_attribute(pool, attribute, (&raw mut most).cast()).w()
    }
}

/// The most bytes of a copy from the host that does not wait for the work queued before it.
const COPY: usize = 1 << 16;

/// Copies values to the memory of a tensor on a GPU, without waiting for the work queued there.
fn copy<T>(gpu: &Gpu, values: &[T], memory: &Tensor) -> Result<()> {
    let (storage, layout) = memory.storage_and_layout();
    let Storage::Cuda(storage) = &*storage else { bail!("a GPU op was given a tensor of another device") };
    if layout.shape().elem_count() != values.len() || !layout.is_contiguous() || layout.start_offset() != 0 {
        bail!("{} values can't be copied to a tensor of {:?}", values.len(), layout.shape());
    }
    let (stream, part) = (gpu.stream(), COPY / size_of::<T>());
    let first = match memory.dtype() {
        DType::F32 => storage.as_cuda_slice::<f32>()?.device_ptr(&stream).0,
        DType::U32 => storage.as_cuda_slice::<u32>()?.device_ptr(&stream).0,
        other => bail!("a tensor of {other:?} is no input"),
    };
    stream.context().bind_to_thread().w()?;
    for (index, values) in values.chunks(part).enumerate() {
        let to = first + (index * COPY) as u64;
        // SAFETY: the memory holds all values, and the driver has read so few of them when it returns.
        unsafe { driver::memcpy_htod_async(to, values, stream.cu_stream()) }.w()?;
    }
    Ok(())
}

/// Returns a launch with one thread for each of `len` values.
fn each(len: usize) -> LaunchConfig {
    blocks(len.div_ceil(BLOCK), BLOCK)
}

/// Returns a launch of `blocks` blocks of `threads` threads.
fn blocks(blocks: usize, threads: usize) -> LaunchConfig {
    LaunchConfig { grid_dim: (blocks as u32, 1, 1), block_dim: (threads as u32, 1, 1), shared_mem_bytes: 0 }
}

/// Returns the values of a contiguous f32 argument of an op.
fn slice<'a>(storage: &'a CudaStorage, layout: &Layout) -> Result<CudaView<'a, f32>> {
    let (start, end) = layout
        .contiguous_offsets()
        .ok_or_else(|| candle_core::Error::RequiresContiguous { op: "harness op" }.bt())?;
    Ok(storage.as_cuda_slice::<f32>()?.slice(start..end))
}

/// Calls `read` with the values of an f32 tensor. Fails if the tensor is not on a GPU.
fn with_values<T>(tensor: &Tensor, read: impl FnOnce(&CudaView<f32>) -> Result<T>) -> Result<T> {
    let tensor = tensor.contiguous()?;
    let (storage, layout) = tensor.storage_and_layout();
    match &*storage {
        Storage::Cuda(storage) => read(&slice(storage, layout)?),
        _ => bail!("a GPU op was given a tensor of another device"),
    }
}

/// Returns the sums of the columns of `values`, `[columns]`. The order of the additions is fixed.
fn column_sums(gpu: &Gpu, values: &CudaView<f32>, columns: usize) -> Result<CudaSlice<f32>> {
    let mut sums = gpu.scratch(columns)?;
    write_column_sums(gpu, values, &mut sums.as_view_mut())?;
    Ok(sums)
}

/// Writes the sums of the columns of `values`, of which there are as many as `sums`.
fn write_column_sums(gpu: &Gpu, values: &CudaView<f32>, sums: &mut CudaViewMut<f32>) -> Result<()> {
    let (rows, columns) = (values.len() / sums.len(), sums.len());
    let config = LaunchConfig {
        grid_dim: (columns.div_ceil(32) as u32, 1, 1),
        block_dim: (32, 32, 1),
        shared_mem_bytes: 0,
    };
    launch!(gpu, VECTORS, "column_sums", config, values, sums, &(rows as i32), &(columns as i32));
    Ok(())
}
