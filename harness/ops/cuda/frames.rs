//! Images of all samples of a dataset, which stay on a GPU.

use super::{Gpu, launch};
use crate::{Values, input};
use candle_core::cuda::WrapErr;
use candle_core::cuda::cudarc::driver::{CudaSlice, DevicePtr, LaunchConfig};
use candle_core::{Device, Result, Storage, Tensor, bail};
use harness_samples::{Normalizer, Sample, Samples};
use harness_spec::Modality;

/// The part of the free memory that the images of a modality may take.
const SHARE: usize = 2;

/// The images of a modality at all samples, and their normalization.
pub struct FrameTable {
    /// `[samples, values of a frame]`, in steps of 1/255. For a difference, the images that it is computed from.
    bytes: CudaSlice<u8>,
    /// For a difference, the sample before each, `[samples]`.
    before: Option<CudaSlice<u32>>,
    mean: CudaSlice<f32>,
    factor: f32,
}

impl FrameTable {
    /// Copies the images to a GPU. `None` if they would take more than half of its free memory.
    pub fn new(
        samples: &Samples,
        modality: Modality,
        scale: &Normalizer,
        device: &Device,
    ) -> Result<Option<Self>> {
        let Device::Cuda(device) = device else { bail!("images for a GPU were given another device") };
        let bytes = samples.image(modality);
        let (free, _) = device.cuda_stream().context().mem_get_info().w()?;
        if bytes.len() > free / SHARE {
            return Ok(None);
        }
        let before: Option<Vec<u32>> = samples.layout()[modality].difference_of.map(|_| {
            let before = |sample| samples.previous(Sample::at(sample)).index() as u32;
            (0..samples.len()).map(before).collect()
        });
        let stream = device.cuda_stream();
        Ok(Some(Self {
            bytes: stream.clone_htod(bytes).w()?,
            before: before.map(|before| stream.clone_htod(&before).w()).transpose()?,
            mean: stream.clone_htod(&scale.mean).w()?,
            factor: 1.0 / scale.std[0],
        }))
    }
}

/// Returns the normalized frames of these samples, `[samples, values of a frame]`.
pub fn gather(table: &FrameTable, samples: Vec<u32>, device: &Device) -> Result<Tensor> {
    let Device::Cuda(cuda) = device else { bail!("images for a GPU were given another device") };
    let (gpu, batch, len) = (Gpu(cuda.clone()), samples.len(), table.mean.len());
    let rows = input(Values::U32(samples), batch, device)?;
    let mut frames = gpu.scratch(batch * len)?;
    let (storage, _) = rows.storage_and_layout();
    let Storage::Cuda(storage) = &*storage else { bail!("the rows are on another device") };
    let rows = storage.as_cuda_slice::<u32>()?;
    let stream = gpu.stream();
    let before = table.before.as_ref().map_or(0_u64, |before| before.device_ptr(&stream).0);
    let config = LaunchConfig {
        grid_dim: (len.div_ceil(256) as u32, batch.min(1024) as u32, 1),
        block_dim: (256, 1, 1),
        shared_mem_bytes: 0,
    };
    let (count, width) = (batch as i32, len as i32);
    launch!(
        gpu,
        FRAMES,
        "gather_frames",
        config,
        &table.bytes,
        rows,
        &before,
        &table.mean,
        &table.factor,
        &mut frames,
        &count,
        &width
    );
    Ok(gpu.tensor(frames, (batch, len)))
}
