//! The state of a training on disk: enough to go on as if it had never stopped.

use super::LearningError;
use super::network::Parameters;
use super::objective::KL;
use super::ops::Adam;
use super::tensors::TensorFile;
use super::training::{Epoch, TOTAL};
use candle_core::{Result as CandleResult, Tensor, Var};
use harness_shared::progress::Progress;
use serde_json::{Map, json};
use std::cell::{Cell, RefCell};
use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// A state is saved after an epoch when the last save took less than this share of the time since.
const SAVE_SHARE: f64 = 0.02;
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
        self.best_epoch_of(TOTAL)
    }

    /// The last epoch, counted from 1, that brought some output modality's validation error to its lowest value so far; 0
    /// before the first.
    pub fn last_improvement(&self) -> usize {
        let terms = self.epochs.first().map(|epoch| epoch.validation.keys()).into_iter().flatten();
        let outputs = terms.filter(|term| ![TOTAL, KL].contains(&term.as_str()));
        outputs.map(|term| self.best_epoch_of(term)).max().unwrap_or_default()
    }

    fn best_epoch_of(&self, term: &str) -> usize {
        let loss = |epoch: &&Epoch| epoch.validation.get(term).copied().unwrap_or(f64::INFINITY);
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
    kept: RefCell<Option<TensorFile>>,
}

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

    /// Saves the state if the last save is long enough ago, and otherwise keeps it in memory.
    pub fn save_now_and_then(
        &self,
        state: &State,
        parameters: &Parameters,
        adam: &Adam,
    ) -> Result<(), LearningError> {
        if self.path.is_none() {
            return Ok(());
        }
        *self.kept.borrow_mut() = Some(contents(state, parameters, adam)?);
        if self.saved.get().elapsed() >= self.interval.get() { self.save_kept() } else { Ok(()) }
    }

    /// Saves the state of the last epoch unless it is saved already.
    pub fn save_kept(&self) -> Result<(), LearningError> {
        let (Some(path), Some(kept)) = (&self.path, self.kept.take()) else { return Ok(()) };
        let begin = Instant::now();
        kept.write(path)?;
        self.saved.set(Instant::now());
        if !self.fixed {
            self.interval.set(begin.elapsed().div_f64(SAVE_SHARE));
        }
        Ok(())
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

/// What a state's file is to hold; nothing of it changes with the parameters.
fn contents(state: &State, parameters: &Parameters, adam: &Adam) -> CandleResult<TensorFile> {
    let mut tensors = HashMap::new();
    for ((name, parameter), (mean, square)) in copies(parameters)?.into_iter().zip(adam.moments()?) {
        tensors.insert(format!("parameter.{name}"), parameter);
        tensors.insert(format!("mean.{name}"), mean);
        tensors.insert(format!("square.{name}"), square);
    }
    tensors.extend(state.best.iter().map(|(name, tensor)| (format!("best.{name}"), tensor.clone())));
    let mut note = Map::new();
    note.insert(EPOCHS.into(), json!(state.epochs));
    note.insert(STEPS.into(), json!(adam.steps()));
    Ok(TensorFile { tensors, note })
}
