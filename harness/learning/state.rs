//! The state of a training on disk: enough to go on as if it had never stopped.

use super::LearningError;
use super::network::Parameters;
use super::ops::Adam;
use super::training::{Epoch, TOTAL};
use crate::files::write_whole;
use candle_core::{Device, Result as CandleResult, Tensor};
use safetensors::SafeTensors;
use std::cell::Cell;
use std::collections::{BTreeMap, HashMap};
use std::path::PathBuf;
use std::time::{Duration, Instant};

/// Time between two saves; what is lost at most when a training is killed.
const SAVE_INTERVAL: Duration = Duration::from_secs(60);
/// Key of the epochs so far in the file's metadata.
const EPOCHS_KEY: &str = "epochs";

/// How far a training is.
#[derive(Default)]
pub struct State {
    pub epochs: Vec<Epoch>,
    /// The parameters of the epoch with the lowest validation loss.
    best: BTreeMap<String, Tensor>,
}

impl State {
    /// The epoch, counted from 1, with the lowest validation loss; 0 before the first.
    pub fn best_epoch(&self) -> usize {
        let loss = |epoch: &&Epoch| epoch.validation.get(TOTAL).copied().unwrap_or(f64::INFINITY);
        self.epochs.iter().min_by(|a, b| loss(a).total_cmp(&loss(b))).map_or(0, |epoch| epoch.epoch)
    }

    /// Appends an epoch, and keeps a copy of the parameters if it is the best so far.
    pub fn record(&mut self, epoch: Epoch, parameters: &Parameters) -> CandleResult<()> {
        self.epochs.push(epoch);
        if self.best_epoch() == self.epochs.len() {
            self.best = copies(parameters)?;
        }
        Ok(())
    }

    /// Sets the parameters to those of the best epoch.
    pub fn restore_best(&self, parameters: &Parameters) -> CandleResult<()> {
        self.best.iter().try_for_each(|(name, tensor)| match parameters.get(name) {
            Some(parameter) => parameter.set(tensor),
            None => Ok(()),
        })
    }
}

/// Deep copies of parameters, which are otherwise changed in place.
pub fn copies(parameters: &Parameters) -> CandleResult<BTreeMap<String, Tensor>> {
    parameters.iter().map(|(name, var)| Ok((name.clone(), var.as_tensor().detach().copy()?))).collect()
}

/// Where a training's state is kept.
pub struct StateFile {
    path: Option<PathBuf>,
    interval: Duration,
    saved: Cell<Instant>,
}

impl StateFile {
    /// In a file.
    pub fn at(path: PathBuf) -> Self {
        Self { path: Some(path), ..Self::none() }
    }

    /// Nowhere: the training can't be resumed.
    pub fn none() -> Self {
        Self { path: None, interval: SAVE_INTERVAL, saved: Cell::new(Instant::now()) }
    }

    /// Saved this often, instead of once a minute.
    pub fn every(self, interval: Duration) -> Self {
        Self { interval, ..self }
    }

    /// Loads the state of an unfinished training into `parameters` and `adam`, if there is one.
    pub fn resume(&self, parameters: &Parameters, adam: &mut Adam) -> Result<Option<State>, LearningError> {
        let Some(path) = self.path.as_ref().filter(|path| path.exists()) else { return Ok(None) };
        let damaged = |reason: String| LearningError::Damaged { path: path.clone(), reason };
        let bytes = std::fs::read(path).map_err(|error| damaged(error.to_string()))?;
        let (_, header) = SafeTensors::read_metadata(&bytes).map_err(|error| damaged(error.to_string()))?;
        let metadata = header.metadata().as_ref();
        let epochs = metadata
            .and_then(|metadata| metadata.get(EPOCHS_KEY))
            .ok_or_else(|| damaged("no epochs".into()))?;
        let steps = metadata
            .and_then(|metadata| metadata.get("steps")?.parse().ok())
            .ok_or_else(|| damaged("no step count".into()))?;
        let epochs = serde_json::from_str(epochs).map_err(|error| damaged(error.to_string()))?;
        let tensors = candle_core::safetensors::load_buffer(&bytes, &Device::Cpu)
            .map_err(|error| damaged(error.to_string()))?;
        let find = |group: &str, name: &str| -> Result<Tensor, LearningError> {
            tensors
                .get(&format!("{group}.{name}"))
                .cloned()
                .ok_or_else(|| damaged(format!("no tensor '{group}.{name}'")))
        };
        let mut moments = Vec::with_capacity(parameters.len());
        let mut best = BTreeMap::new();
        for (name, parameter) in parameters {
            parameter.set(&find("parameter", name)?.to_device(parameter.device())?)?;
            moments.push((
                find("mean", name)?.to_device(parameter.device())?,
                find("square", name)?.to_device(parameter.device())?,
            ));
            best.insert(name.clone(), find("best", name)?.to_device(parameter.device())?);
        }
        adam.restore(steps, &moments)?;
        Ok(Some(State { epochs, best }))
    }

    /// Saves the state if the last save is long enough ago.
    pub fn save_now_and_then(
        &self,
        state: &State,
        parameters: &Parameters,
        adam: &Adam,
    ) -> Result<(), LearningError> {
        if self.saved.get().elapsed() < self.interval {
            return Ok(());
        }
        self.save(state, parameters, adam)?;
        self.saved.set(Instant::now());
        Ok(())
    }

    fn save(&self, state: &State, parameters: &Parameters, adam: &Adam) -> Result<(), LearningError> {
        let Some(path) = &self.path else { return Ok(()) };
        let mut tensors = HashMap::new();
        for ((name, parameter), (mean, square)) in parameters.iter().zip(adam.moments()?) {
            tensors.insert(format!("parameter.{name}"), parameter.as_tensor().clone());
            tensors.insert(format!("mean.{name}"), mean);
            tensors.insert(format!("square.{name}"), square);
        }
        tensors.extend(state.best.iter().map(|(name, tensor)| (format!("best.{name}"), tensor.clone())));
        let epochs = serde_json::to_string(&state.epochs)
            .map_err(|error| LearningError::Damaged { path: path.clone(), reason: error.to_string() })?;
        let metadata =
            HashMap::from([(EPOCHS_KEY.to_owned(), epochs), ("steps".to_owned(), adam.steps().to_string())]);
        write_whole(path, |file| {
            safetensors::serialize_to_file(&tensors, Some(metadata.clone()), file)
                .map_err(std::io::Error::other)
        })?;
        Ok(())
    }
}
