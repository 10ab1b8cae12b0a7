//! The state of a training on disk: enough to go on as if it had never stopped.

use super::LearningError;
use super::network::Parameters;
use super::ops::Adam;
use super::training::{Epoch, TOTAL};
use crate::files::write_whole;
use candle_core::{Device, Result as CandleResult, Tensor};
use safetensors::SafeTensors;
use std::cell::{Cell, RefCell};
use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// A state is saved after an epoch when the last save took less than this share of the time since.
const SAVE_SHARE: f64 = 0.02;
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
///
/// How often it is saved follows from how long that takes: what is lost at most when a training is killed is an epoch,
/// or fifty times what a save takes if that is longer. A training that is cancelled loses no whole epoch.
pub struct StateFile {
    path: Option<PathBuf>,
    /// Time between two saves, from the end of the last.
    interval: Cell<Duration>,
    fixed: bool,
    saved: Cell<Instant>,
    /// What the file would hold had the last epoch been saved, where it was not.
    kept: RefCell<Option<Contents>>,
}

/// Tensors and metadata of a state's file.
type Contents = (HashMap<String, Tensor>, HashMap<String, String>);

impl StateFile {
    /// In a file.
    pub fn at(path: PathBuf) -> Self {
        Self { path: Some(path), ..Self::none() }
    }

    /// Nowhere: the training can't be resumed.
    pub fn none() -> Self {
        let (interval, saved) = (Cell::default(), Cell::new(Instant::now()));
        Self { path: None, interval, fixed: false, saved, kept: RefCell::default() }
    }

    /// Saved this often, however long it takes.
    pub fn every(self, interval: Duration) -> Self {
        Self { interval: Cell::new(interval), fixed: true, ..self }
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

    /// Saves the state if the last save is long enough ago, and otherwise keeps it in memory.
    pub fn save_now_and_then(
        &self,
        state: &State,
        parameters: &Parameters,
        adam: &Adam,
    ) -> Result<(), LearningError> {
        let Some(path) = &self.path else { return Ok(()) };
        *self.kept.borrow_mut() = Some(contents(path, state, parameters, adam)?);
        if self.saved.get().elapsed() >= self.interval.get() { self.save_kept() } else { Ok(()) }
    }

    /// Saves the state of the last epoch unless it is saved already.
    pub fn save_kept(&self) -> Result<(), LearningError> {
        let (Some(path), Some((tensors, metadata))) = (&self.path, self.kept.take()) else { return Ok(()) };
        let begin = Instant::now();
        write_whole(path, |file| {
            safetensors::serialize_to_file(&tensors, Some(metadata.clone()), file)
                .map_err(std::io::Error::other)
        })?;
        self.saved.set(Instant::now());
        if !self.fixed {
            self.interval.set(begin.elapsed().div_f64(SAVE_SHARE));
        }
        Ok(())
    }
}

/// What a state's file holds; nothing of it changes with the parameters.
fn contents(
    path: &Path,
    state: &State,
    parameters: &Parameters,
    adam: &Adam,
) -> Result<Contents, LearningError> {
    let mut tensors = HashMap::new();
    for ((name, parameter), (mean, square)) in copies(parameters)?.into_iter().zip(adam.moments()?) {
        tensors.insert(format!("parameter.{name}"), parameter);
        tensors.insert(format!("mean.{name}"), mean);
        tensors.insert(format!("square.{name}"), square);
    }
    tensors.extend(state.best.iter().map(|(name, tensor)| (format!("best.{name}"), tensor.clone())));
    let epochs = serde_json::to_string(&state.epochs)
        .map_err(|error| LearningError::Damaged { path: path.to_owned(), reason: error.to_string() })?;
    let metadata =
        HashMap::from([(EPOCHS_KEY.to_owned(), epochs), ("steps".to_owned(), adam.steps().to_string())]);
    Ok((tensors, metadata))
}
