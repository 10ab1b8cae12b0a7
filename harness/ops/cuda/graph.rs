//! A training step that is recorded once and then repeated as a CUDA graph, by one call of the driver.
//!
//! Without it, a step of a small network takes as long as the calls that queue its hundreds of kernels. A graph repeats
//! the same work on the same memory, so whatever the host gives to a step must lie where the graph reads it: every copy
//! from the host ([`copied`]) is an input of the step. A step is run twice to record it. In the first run, inputs are
//! copied to memory that stays. In the second one, the stream records the work instead of doing it, and each copy is
//! replaced by the input of the same place in the order.

use super::{Gpu, copy};
use crate::Values;
use candle_core::cuda::WrapErr;
use candle_core::cuda::cudarc::driver::{CudaGraph, sys};
use candle_core::{DType, Device, Result, Shape, Tensor, bail};
use std::cell::RefCell;

/// An input of a step.
pub struct Input {
    /// The values in the first run.
    pub values: Values,
    memory: Tensor,
}

enum Tape {
    /// Copies are made as usual.
    Off,
    /// Copies become inputs.
    First(Vec<Input>),
    /// Copies are replaced by the inputs, of which so many have been used.
    Second(Vec<Input>, usize),
}

thread_local! {
    static TAPE: RefCell<Tape> = const { RefCell::new(Tape::Off) };
}

fn written(values: &Values, gpu: &Gpu, memory: &Tensor) -> Result<()> {
    match values {
        Values::F32(values) => copy(gpu, values, memory),
        Values::U32(values) => copy(gpu, values, memory),
    }
}

/// Copies values to new memory.
fn moved(values: &Values, gpu: &Gpu) -> Result<Tensor> {
    let (device, len) = (Device::Cuda(gpu.0.clone()), values.len());
    let dtype = match values {
        Values::F32(_) => DType::F32,
        Values::U32(_) => DType::U32,
    };
    // SAFETY: all values are written before they are read.
    let memory = unsafe { Tensor::empty(len, dtype, &device) }?;
    written(values, gpu, &memory)?;
    Ok(memory)
}

/// Copies values to a GPU, as an input of the step that is being recorded.
pub(crate) fn copied(values: Values, shape: impl Into<Shape>, device: &Device) -> Result<Tensor> {
    let Device::Cuda(device) = device else { bail!("values for a GPU were given another device") };
    let gpu = Gpu(device.clone());
    TAPE.with_borrow_mut(|tape| match tape {
        Tape::Off => moved(&values, &gpu),
        Tape::First(inputs) => {
            let memory = moved(&values, &gpu)?;
            inputs.push(Input { values, memory: memory.clone() });
            Ok(memory)
        }
        Tape::Second(inputs, next) => {
            *next += 1;
            match inputs.get(*next - 1) {
                Some(input) if input.values.len() == values.len() => Ok(input.memory.clone()),
                _ => bail!("a repeated training step has other inputs than the first one"),
            }
        }
    })?
    .reshape(shape)
}

/// The recorded work of a step.
pub struct Graph {
    gpu: Gpu,
    graph: CudaGraph,
    inputs: Vec<Tensor>,
    results: Tensor,
}

/// Does a step, and returns its results and inputs.
///
/// # Errors
/// Those of the step, and when the device is no GPU.
pub fn first_run(device: &Device, step: impl FnOnce() -> Result<Tensor>) -> Result<(Tensor, Vec<Input>)> {
    let Device::Cuda(device) = device else { bail!("a step on a GPU was given another device") };
    // The parameters of candle's kernels are kept on the GPU, where the second run finds them.
    let _kept = device.enable_cuda_graph_htod_cache();
    TAPE.set(Tape::First(Vec::new()));
    let results = step();
    let Tape::First(inputs) = TAPE.replace(Tape::Off) else {
        bail!("a step was recorded within another one")
    };
    Ok((results?, inputs))
}

impl Graph {
    /// Records a step that has had its first run with these inputs, without doing it. `results` is the memory of its
    /// results.
    pub fn record(
        device: &Device,
        inputs: Vec<Input>,
        results: Tensor,
        step: impl FnOnce() -> Result<Tensor>,
    ) -> Result<Self> {
        let Device::Cuda(device) = device else { bail!("a step on a GPU was given another device") };
        let (gpu, stream) = (Gpu(device.clone()), device.cuda_stream());
        let _kept = device.enable_cuda_graph_htod_cache();
        let memory = inputs.iter().map(|input| input.memory.clone()).collect();
        TAPE.set(Tape::Second(inputs, 0));
        stream.begin_capture(sys::CUstreamCaptureMode::CU_STREAM_CAPTURE_MODE_THREAD_LOCAL).w()?;
        // The step's own memory is freed within the graph.
        let done = step().and_then(|found| results.slice_set(&found, 0, 0));
        let graph = stream.end_capture(sys::CUgraphInstantiate_flags(0)).w();
        let used = match TAPE.replace(Tape::Off) {
            Tape::Second(inputs, used) => used == inputs.len(),
            _ => false,
        };
        done?;
        match graph? {
            Some(graph) if used => Ok(Self { gpu, graph, inputs: memory, results }),
            _ => bail!("a repeated training step has other inputs than the first one"),
        }
    }

    /// Repeats the step with other inputs, in the order of the first run. Returns its results.
    pub fn repeat(&self, inputs: &[Values]) -> Result<Tensor> {
        for (values, memory) in inputs.iter().zip(&self.inputs) {
            written(values, &self.gpu, memory)?;
        }
        self.graph.launch().w()?;
        self.results.copy()
    }
}
