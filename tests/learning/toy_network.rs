//! A network with a state: it adds up the actions, and averages what it sees with what it expected.

use candle_core::{Device, Result, Tensor, Var};
use harness_learning::network::{
    Decoded, Draw, Network, Observation, Parameters, Seen, State, Targets, Term,
};
use harness_spec::Modality;

/// Predicts the arm's positions: the last ones, plus the action times a learned factor, plus a learned constant.
pub struct Integrator {
    factor: Tensor,
    constant: Tensor,
}

impl Integrator {
    pub fn new(elements: usize, parameters: &mut Parameters) -> Result<Self> {
        let mut zeros = |name: &str| {
            let var = Var::zeros(elements, candle_core::DType::F32, &Device::Cpu)?;
            parameters.insert(name.to_owned(), var.clone());
            Ok::<_, candle_core::Error>(var.as_tensor().clone())
        };
        Ok(Self { factor: zeros("factor")?, constant: zeros("constant")? })
    }
}

impl Network for Integrator {
    fn start(&self, batch: usize, device: &Device) -> Result<Option<State>> {
        let zeros = |width: usize| Tensor::zeros((batch, width), candle_core::DType::F32, device);
        let (latent, seen) = (zeros(self.factor.dim(0)?)?, zeros(1)?);
        Ok(Some(State { latent, action: None, memory: Some(seen) }))
    }

    fn encode(&self, seen: &Observation, _: &mut Draw) -> Result<Tensor> {
        seen.vectors(&[Modality::ARM])
    }

    fn observe(&self, state: Option<&State>, positions: &Tensor, _: &mut Draw) -> Result<Seen> {
        let Some(State { latent, memory: Some(count), .. }) = state else { candle_core::bail!("no state") };
        let share = (count + 1.0)?.recip()?;
        let latent = (latent + (positions - latent)?.broadcast_mul(&share)?)?;
        let state = State { latent, action: None, memory: Some((count + 1.0)?) };
        Ok(Seen { state, divergence: Tensor::new(0f32, &Device::Cpu)?, divergences: None })
    }

    fn act(&self, state: &State, action: &Tensor) -> Result<State> {
        let moved = action.broadcast_mul(&self.factor)?.broadcast_add(&self.constant)?;
        Ok(State { latent: (&state.latent + moved)?, ..state.clone() })
    }

    fn decode(&self, state: &State) -> Result<Decoded> {
        Ok(Decoded::from([(Modality::ARM, state.latent.clone())]))
    }

    fn losses(&self, state: &State, targets: Targets) -> Result<Vec<Term>> {
        let error = (&state.latent - targets.values.vectors(&[Modality::ARM])?)?;
        Ok(vec![Term { modality: Modality::ARM, value: error.sqr()?.reshape((targets.parts, ()))?.mean(1)? }])
    }

    fn detached(&self) -> Box<dyn Network> {
        Box::new(Self { factor: self.factor.detach(), constant: self.constant.detach() })
    }
}
