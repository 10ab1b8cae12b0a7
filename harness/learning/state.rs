//! The state of a training on disk. A training that is resumed from it gives the same result as one without a break.

use super::LearningError;
use super::network::Parameters;
use super::objective::KL;
use super::ops::Adam;
use super::tensors::TensorFile;
use candle_core::{Result as CandleResult, Tensor, Var};
use harness_metrics::epoch::{Epoch, TOTAL};
use harness_shared::progress::Progress;
use serde_json::{Map, json};
use std::cell::{Cell, RefCell};
use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// The state is saved after an epoch if the last save took less than this share of the time since then.
const SAVE_SHARE: f64 = 0.02;
/// Keys in the file's note: the epochs so far, and the number of the optimizer's steps.
const EPOCHS: &str = "epochs";
const STEPS: &str = "steps";

/// The progress of a training.
#[derive(Default)]
pub struct State {
    /// Losses of the epochs so far, in order.
    pub epochs: Vec<Epoch>,
    /// The parameters of the epoch with the lowest validation loss.
    best: BTreeMap<String, Tensor>,
}

impl State {
    /// Returns the epoch with the lowest validation loss, counted from 1; 0 before the first epoch.
    pub fn best_epoch(&self) -> usize {
        self.best_epoch_of(TOTAL)
    }

    /// Returns the last epoch, counted from 1, in which the validation error of some output modality reached a new
    /// minimum; 0 before the first epoch.
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

/// Returns deep copies of the parameters, because training changes the parameters in place.
pub fn copies(parameters: &Parameters) -> CandleResult<BTreeMap<String, Tensor>> {
    parameters.iter().map(|(name, var)| Ok((name.clone(), var.as_tensor().detach().copy()?))).collect()
}

/// The file in which a training's state is saved.
///
/// The time between saves follows from the duration of a save. A killed training loses at most one epoch, or fifty
/// times the duration of a save if that is longer. A cancelled training loses no complete epoch.
pub struct StateFile {
    path: Option<PathBuf>,
    /// Least time from the end of one save to the next save.
    interval: Cell<Duration>,
    /// Whether the caller has set `interval`.
    fixed: bool,
    /// End of the last save.
    saved: Cell<Instant>,
    /// Contents of the last epoch's state, if that was not saved.
    kept: RefCell<Option<TensorFile>>,
}

impl StateFile {
    /// Saves the state in the file `path`.
    pub fn at(path: PathBuf) -> Self {
        Self { path: Some(path), ..Self::none() }
    }

    /// Saves nothing, so the training can't be resumed.
    pub fn none() -> Self {
        let (interval, saved) = (Cell::default(), Cell::new(Instant::now()));
        Self { path: None, interval, fixed: false, saved, kept: RefCell::default() }
    }

    /// Saves the state at this interval, however long a save takes.
    pub fn every(self, interval: Duration) -> Self {
        Self { interval: Cell::new(interval), fixed: true, ..self }
    }

    /// Loads the state of an unfinished training into `parameters` and `adam`, if there is one.
    ///
    /// A damaged state is reported and ignored. The training then starts again, which costs time but gives the same
    /// result.
    pub fn resume(
        &self,
        parameters: &Parameters,
        adam: &mut Adam,
        progress: &dyn Progress,
    ) -> Result<Option<State>, LearningError> {
        let Some(path) = self.path.as_ref().filter(|path| path.exists()) else { return Ok(None) };
        let saved = match TensorFile::read(path).and_then(|file| Saved::find(path, &file, parameters)) {
            Err(LearningError::Damaged { path, reason }) => {
                progress.say(&format!("{} is damaged ({reason}); its training starts again", path.display()));
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

    /// Saves the state if the time between saves has passed. Otherwise keeps it in memory.
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

    /// Saves the state of the last epoch, unless it has been saved already.
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

/// Contents of a state file. All tensors have the shapes that the training expects.
struct Saved {
    /// In the order of the parameters, like the moments.
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

/// Returns the contents of a state file. Its tensors are copies, so later steps do not change them.
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
