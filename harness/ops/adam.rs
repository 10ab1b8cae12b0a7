//! Adam as one pass over a parameter and its moments, in place. The pass includes weight decay and the scaling of
//! clipped gradients. Clipping reads the gradients once more before, to compute their norm.

use super::{Values, slice, with_values};
use candle_core::backprop::GradStore;
use candle_core::{CpuStorage, Device, InplaceOp2, Layout, Result, Tensor, Var};
use harness_kernels::adam::{AdamStep, adam, sum_of_squares};
use std::sync::Mutex;

const BETA_MEAN: f64 = 0.9;
const BETA_SQUARE: f64 = 0.999;
const EPSILON: f64 = 1e-8;

/// Adam (Kingma & Ba, 2015, algorithm 1) with its usual constants, over a fixed list of parameters.
///
/// With weight decay, it is AdamW (Loshchilov & Hutter, 2019).
pub struct Adam {
    learning_rate: f64,
    weight_decay: f64,
    clip_norm: Option<f64>,
    steps: u64,
    slots: Vec<Slot>,
}

struct Slot {
    parameter: Var,
    moments: Moments,
}

/// Running means of a parameter's gradient and of the gradient's square.
enum Moments {
    /// Updated in place.
    Cpu { mean: Vec<f32>, square: Vec<f32> },
    /// On a GPU, and updated in place.
    Device { mean: Tensor, square: Tensor },
}

impl Adam {
    /// Creates an optimizer for `parameters`, with zero moments, no weight decay and no clipping.
    pub fn new(parameters: Vec<Var>, learning_rate: f64) -> Result<Self> {
        let slots = parameters.into_iter().map(|parameter| {
            let zeros = parameter.zeros_like()?;
            let moments = Moments::new(&zeros, &zeros)?;
            Ok(Slot { parameter, moments })
        });
        let slots = slots.collect::<Result<_>>()?;
        Ok(Self { learning_rate, weight_decay: 0.0, clip_norm: None, steps: 0, slots })
    }

    /// Sets the weight decay. Each step subtracts `weight_decay` times the learning rate times the weight. Only
    /// parameters of rank 2 or more decay, because vectors are biases.
    pub fn with_weight_decay(self, weight_decay: f64) -> Self {
        Self { weight_decay, ..self }
    }

    /// Sets the largest Euclidean norm of the gradient of all parameters together. A longer gradient is scaled down to
    /// it.
    pub fn with_clip_norm(self, clip_norm: Option<f64>) -> Self {
        Self { clip_norm, ..self }
    }

    /// Sets the learning rate of the following steps.
    pub fn set_learning_rate(&mut self, learning_rate: f64) {
        self.learning_rate = learning_rate;
    }

    /// Returns the number of steps taken so far.
    pub fn steps(&self) -> u64 {
        self.steps
    }

    /// Returns the two moments (mean, mean square) of every parameter. They have its shape, and the order of the
    /// parameters.
    pub fn moments(&self) -> Result<Vec<(Tensor, Tensor)>> {
        self.slots.iter().map(|slot| slot.moments.tensors(&slot.parameter)).collect()
    }

    /// Continues after another optimizer: sets the number of its steps, and its moments in the order of the parameters.
    pub fn restore(&mut self, steps: u64, moments: &[(Tensor, Tensor)]) -> Result<()> {
        if moments.len() != self.slots.len() {
            candle_core::bail!("{} pairs of moments for {} parameters", moments.len(), self.slots.len());
        }
        self.steps = steps;
        for (slot, (mean, square)) in self.slots.iter_mut().zip(moments) {
            if mean.shape() != slot.parameter.shape() || square.shape() != slot.parameter.shape() {
                candle_core::bail!("moments of shape {:?} for {:?}", mean.shape(), slot.parameter.shape());
            }
            slot.moments = Moments::new(mean, square)?;
        }
        Ok(())
    }

    /// Takes one step. Parameters without a gradient do not change.
    pub fn step(&mut self, gradients: &GradStore) -> Result<()> {
        self.steps += 1;
        #[cfg(feature = "cuda")]
        if self.slots.first().is_some_and(|slot| slot.parameter.device().is_cuda()) {
            return self.step_on_gpu(gradients);
        }
        let [learning_rate, mean_correction, square_correction, decayed] = self.factors();
        let step = AdamStep {
            gradient_scale: self.gradient_scale(gradients)? as f32,
            kept: 1.0,
            learning_rate,
            beta_mean: BETA_MEAN as f32,
            beta_square: BETA_SQUARE as f32,
            epsilon: EPSILON as f32,
            mean_correction,
            square_correction,
        };
        for slot in &mut self.slots {
            if let Some(grad) = gradients.get(&slot.parameter) {
                let kept = if slot.parameter.rank() > 1 { decayed } else { 1.0 };
                slot.moments.step(AdamStep { kept, ..step }, &slot.parameter, grad)?;
            }
        }
        Ok(())
    }

    /// Returns what differs from step to step: the learning rate, the corrections of both moments, and the share of
    /// decaying parameters that remains.
    fn factors(&self) -> [f32; 4] {
        let correction = |beta: f64| (1.0 / (1.0 - beta.powf(self.steps as f64))) as f32;
        let decayed = (1.0 - self.learning_rate * self.weight_decay) as f32;
        [self.learning_rate as f32, correction(BETA_MEAN), correction(BETA_SQUARE), decayed]
    }

    /// Returns the GPU on which the parameters are, if they are on one.
    pub fn gpu(&self) -> Option<Device> {
        let device = self.slots.first()?.parameter.device();
        device.is_cuda().then(|| device.clone())
    }

    /// Counts one more step, which is taken elsewhere with the returned values.
    pub fn count(&mut self) -> Values {
        self.steps += 1;
        self.input()
    }

    /// Returns the values that the last step took from the host, on a GPU.
    pub fn input(&self) -> Values {
        Values::F32(self.factors().to_vec())
    }

    /// Sets the number of steps taken so far.
    pub fn set_steps(&mut self, steps: u64) {
        self.steps = steps;
    }

    #[cfg(feature = "cuda")]
    fn step_on_gpu(&self, gradients: &GradStore) -> Result<()> {
        let mut slots = Vec::with_capacity(self.slots.len());
        for Slot { parameter, moments } in &self.slots {
            if let (Some(grad), Moments::Device { mean, square }) = (gradients.get(parameter), moments) {
                let (parameter, grad) = (parameter.as_tensor(), grad.contiguous()?);
                slots.push(crate::cuda::Slot { parameter, grad, mean, square });
            }
        }
        let Some(first) = slots.first() else { return Ok(()) };
        let scale = match self.clip_norm {
            None => Tensor::ones((), candle_core::DType::F32, first.parameter.device())?,
            Some(clip_norm) => {
                let squares = slots.iter().map(|slot| slot.grad.sqr()?.sum_all());
                let norm = Tensor::stack(&squares.collect::<Result<Vec<_>>>()?, 0)?.sum_all()?.sqrt()?;
                (norm.recip()? * clip_norm)?.minimum(1.0)?
            }
        };
        let factors = crate::input(self.input(), 4, first.parameter.device())?;
        let constants = [BETA_MEAN, BETA_SQUARE, EPSILON].map(|constant| constant as f32);
        crate::cuda::adam(constants, &factors, &slots, &scale)
    }

    /// Returns the factor by which clipping scales the gradients.
    fn gradient_scale(&self, gradients: &GradStore) -> Result<f64> {
        let Some(clip_norm) = self.clip_norm else { return Ok(1.0) };
        let found = self.slots.iter().filter_map(|slot| gradients.get(&slot.parameter));
        let squares = found.map(|gradient| with_values(gradient, |values| Ok(sum_of_squares(values))));
        let squares = squares.sum::<Result<f64>>()?;
        Ok((clip_norm / squares.sqrt()).min(1.0))
    }
}

impl Moments {
    fn new(mean: &Tensor, square: &Tensor) -> Result<Self> {
        if mean.device().is_cpu() {
            let values = |tensor: &Tensor| tensor.flatten_all()?.to_vec1::<f32>();
            return Ok(Self::Cpu { mean: values(mean)?, square: values(square)? });
        }
        Ok(Self::Device { mean: mean.copy()?, square: square.copy()? })
    }

    fn tensors(&self, parameter: &Var) -> Result<(Tensor, Tensor)> {
        let tensor = |values: &[f32]| Tensor::from_slice(values, parameter.shape(), &Device::Cpu);
        match self {
            Self::Cpu { mean, square } => Ok((tensor(mean)?, tensor(square)?)),
            Self::Device { mean, square } => Ok((mean.copy()?, square.copy()?)),
        }
    }

    fn step(&mut self, step: AdamStep, parameter: &Var, grad: &Tensor) -> Result<()> {
        match self {
            Self::Cpu { mean, square } => parameter
                .inplace_op2(&grad.contiguous()?, &AdamOp { step, moments: Mutex::new((mean, square)) }),
            Self::Device { .. } => candle_core::bail!("this program was built without CUDA"),
        }
    }
}

struct AdamOp<'a> {
    step: AdamStep,
    /// candle gives an op only shared access to itself. No other code takes this lock.
    moments: Mutex<(&'a mut [f32], &'a mut [f32])>,
}

impl InplaceOp2 for AdamOp<'_> {
    fn name(&self) -> &'static str {
        "adam"
    }

    fn cpu_fwd(
        &self,
        parameter: &mut CpuStorage,
        parameter_layout: &Layout,
        grad: &CpuStorage,
        grad_layout: &Layout,
    ) -> Result<()> {
        let (CpuStorage::F32(parameter), Some((start, end))) =
            (parameter, parameter_layout.contiguous_offsets())
        else {
            candle_core::bail!("Adam works on contiguous f32 parameters");
        };
        let mut moments = self.moments.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
        let (mean, square) = &mut *moments;
        adam(self.step, &mut parameter[start..end], slice(grad, grad_layout)?, mean, square);
        Ok(())
    }
}
