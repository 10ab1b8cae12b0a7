//! The state of a training on disk: enough to go on as if it had never stopped.

use super::LearningError;
use super::network::Parameters;
use super::ops::Adam;
use super::tensors::TensorFile;
use super::training::{Epoch, TOTAL};
use crate::progress::Progress;
use candle_core::{Result as CandleResult, Tensor, Var};
use serde_json::{Map, json};
use std::cell::Cell;
use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Time between two saves; what is lost at most when a training is killed.
const SAVE_INTERVAL: Duration = Duration::from_secs(60);
/// Keys of the epochs so far, and of the optimiser's step, in the file's note.
const EPOCHS: &str = "epochs";
const STEPS: &str = "steps";

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
    ///
    /// A state that is not as it was written is left alone and said so: the training begins anew, which costs time
    /// and nothing else, since it comes to the same end.
    pub fn resume(
        &self,
        parameters: &Parameters,
        adam: &mut Adam,
        progress: &dyn Progress,
    ) -> Result<Option<State>, LearningError> {
        let Some(path) = self.path.as_ref().filter(|path| path.exists()) else { return Ok(None) };
        let saved = match TensorFile::read(path).and_then(|file| Saved::find(path, &file, parameters)) {
            Err(LearningError::Damaged { path, reason }) => {
                progress.say(&format!("{} is damaged ({reason}); its training begins anew", path.display()));
                return Ok(None);
            }
            saved => saved?,
        };
        for (parameter, value) in parameters.values().zip(&saved.parameters) {
            parameter.set(value)?;
        }
        adam.restore(saved.steps, &saved.moments)?;
        Ok(Some(saved.state))
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
        let mut note = Map::new();
        note.insert(EPOCHS.into(), json!(state.epochs));
        note.insert(STEPS.into(), json!(adam.steps()));
        TensorFile { tensors, note }.write(path)
    }
}

/// What a state's file holds, with the shapes that the training expects.
struct Saved {
    /// In the order of the parameters, as the moments are.
    parameters: Vec<Tensor>,
    /// Mean and mean square of each parameter's gradient.
    moments: Vec<(Tensor, Tensor)>,
    steps: u64,
    state: State,
}

impl Saved {
    fn find(path: &Path, file: &TensorFile, parameters: &Parameters) -> Result<Self, LearningError> {
        let damaged = |reason: String| LearningError::Damaged { path: path.to_owned(), reason };
        let noted = |key: &str| file.note.get(key).cloned().unwrap_or_default();
        let epochs: Vec<Epoch> =
            serde_json::from_value(noted(EPOCHS)).map_err(|error| damaged(format!("epochs: {error}")))?;
        let steps =
            serde_json::from_value(noted(STEPS)).map_err(|error| damaged(format!("steps: {error}")))?;
        let group = |group: &str| -> Result<Vec<Tensor>, LearningError> {
            let find = |(name, like): (&String, &Var)| file.like(&format!("{group}.{name}"), like);
            parameters.iter().map(find).collect::<Result<_, String>>().map_err(damaged)
        };
        let moments = group("mean")?.into_iter().zip(group("square")?).collect();
        let best = parameters.keys().cloned().zip(group("best")?).collect();
        Ok(Self { parameters: group("parameter")?, moments, steps, state: State { epochs, best } })
    }
}
