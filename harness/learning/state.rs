//! The state of a training on disk. A training that is resumed from it gives the same result as one without a break.

use super::LearningError;
use super::network::Parameters;
use super::objective::KL;
use super::tensors::TensorFile;
use candle_core::{Result as CandleResult, Tensor, Var};
use harness_metrics::epoch::{Epoch, TOTAL};
use harness_ops::Adam;
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
    pub(crate) epochs: Vec<Epoch>,
    /// The lowest validation loss of each term, and the first epoch that had it.
    lowest: BTreeMap<String, (f64, usize)>,
    /// The parameters of the epoch with the lowest validation loss.
    best: BTreeMap<String, Tensor>,
}

impl State {
    /// Returns the epoch with the lowest validation loss, counted from 1; 0 before the first epoch. Without validation
    /// losses, that is the first epoch.
    pub(crate) fn best_epoch(&self) -> usize {
        self.lowest.get(TOTAL).map_or(self.epochs.len().min(1), |(_, epoch)| *epoch)
    }

    /// Returns the last epoch, counted from 1, in which the validation error of some output modality reached a new
    /// minimum; 0 before the first epoch.
    pub(crate) fn last_improvement(&self) -> usize {
        let outputs = self.lowest.iter().filter(|(term, _)| ![TOTAL, KL].contains(&term.as_str()));
        outputs.map(|(_, (_, epoch))| *epoch).max().unwrap_or_default()
    }

    fn push(&mut self, epoch: Epoch) {
        for (term, loss) in &epoch.validation {
            match self.lowest.get_mut(term) {
                Some((lowest, _)) if loss.total_cmp(lowest).is_ge() => {}
                Some(lowest) => *lowest = (*loss, epoch.epoch),
                None => drop(self.lowest.insert(term.clone(), (*loss, epoch.epoch))),
            }
        }
        self.epochs.push(epoch);
    }

    /// Appends an epoch, and keeps a copy of the parameters if it is the best so far.
    pub fn record(&mut self, epoch: Epoch, parameters: &Parameters) -> CandleResult<()> {
        self.push(epoch);
        if self.best_epoch() == self.epochs.len() {
            self.best = copies(parameters)?;
        }
        Ok(())
    }

    /// Sets the parameters to those of the best epoch.
    pub(crate) fn restore_best(&self, parameters: &Parameters) -> CandleResult<()> {
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
    /// The tensors of the last epoch's state, and the number of the optimizer's steps, if that state was not saved.
    kept: RefCell<Option<(HashMap<String, Tensor>, u64)>>,
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
    ///
    /// # Errors
    /// When the state can't be applied to the parameters. A damaged file is no error.
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
    pub(crate) fn save_now_and_then(
        &self,
        state: &State,
        parameters: &Parameters,
        adam: &Adam,
    ) -> Result<(), LearningError> {
        if self.path.is_none() {
            return Ok(());
        }
        *self.kept.borrow_mut() = Some((tensors(state, parameters, adam)?, adam.steps()));
        if self.saved.get().elapsed() >= self.interval.get() { self.save_kept(state) } else { Ok(()) }
    }

    /// Saves the state of the last epoch, unless it has been saved already. `state` is that of the last call of
    /// [`save_now_and_then`](Self::save_now_and_then).
    pub(crate) fn save_kept(&self, state: &State) -> Result<(), LearningError> {
        let (Some(path), Some((tensors, steps))) = (&self.path, self.kept.take()) else { return Ok(()) };
        let begin = Instant::now();
        let mut note = Map::new();
        note.insert(EPOCHS.into(), json!(state.epochs));
        note.insert(STEPS.into(), json!(steps));
        TensorFile { tensors, note }.write(path)?;
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
        let mut state = State { best, ..State::default() };
        epochs.into_iter().for_each(|epoch| state.push(epoch));
        Ok(Self { parameters: group("parameter")?, moments, steps, state })
    }
}

/// Returns the tensors of a state file. They are copies, so later steps do not change them.
fn tensors(state: &State, parameters: &Parameters, adam: &Adam) -> CandleResult<HashMap<String, Tensor>> {
    let mut tensors = HashMap::new();
    for ((name, parameter), (mean, square)) in copies(parameters)?.into_iter().zip(adam.moments()?) {
        tensors.insert(format!("parameter.{name}"), parameter);
        tensors.insert(format!("mean.{name}"), mean);
        tensors.insert(format!("square.{name}"), square);
    }
    tensors.extend(state.best.iter().map(|(name, tensor)| (format!("best.{name}"), tensor.clone())));
    Ok(tensors)
}
