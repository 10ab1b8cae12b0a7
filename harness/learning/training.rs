//! The training loop: epochs of Adam steps, validation, early stopping, and saved states.

use super::LearningError;
use super::network::{Architecture, Draw, Parameters, Score};
use super::objective::Objective;
use super::random::{Random, Stream};
use super::state::{State, StateFile};
use super::steps::{StepLosses, Steps};
use candle_core::{Result as CandleResult, Tensor};
use harness_ops::Adam;
use harness_samples::{Partition, sequences};
use harness_shared::progress::Progress;
use harness_spec::{Schedule, Stop, Task, Training};
use std::f64::consts::PI;
use std::time::Instant;

pub use harness_metrics::epoch::{Epoch, Losses, TOTAL};

/// Returns the learning rate of a training step. Steps are counted from 0 over all epochs, and an epoch has
/// `epoch_steps` of them. The rate depends on nothing else, so a resumed training takes the same steps as one without a
/// break.
pub fn learning_rate(training: &Training, epoch_steps: usize, step: u64) -> f64 {
    let (step, epoch_steps) = (step as f64, epoch_steps as f64);
    let (warmup, end) = (training.warmup_epochs * epoch_steps, training.epochs as f64 * epoch_steps);
    let share = if step < warmup {
        // With a rate of 0, the first step would change nothing.
        ((step + 1.0) / warmup).min(1.0)
    } else {
        match training.schedule {
            Schedule::Constant => 1.0,
            Schedule::Cosine => 0.5 + 0.5 * (PI * (step - warmup) / (end - warmup)).cos(),
        }
    };
    training.learning_rate * share
}

/// The settings, data and surroundings of one training.
pub struct Fit<'a> {
    /// What is trained.
    pub task: Task,
    /// Settings of the training.
    pub training: &'a Training,
    /// Seed of the order of the samples, the latent noise and the dropout.
    pub seed: u64,
    /// Samples for training and validation.
    pub partition: &'a Partition,
    /// Where the state is saved. A state that exists there is resumed.
    pub state: &'a StateFile,
    /// Receives the progress, and can cancel the training.
    pub progress: &'a dyn Progress,
    /// Receives all epochs so far, at the beginning and after each epoch.
    pub log: &'a dyn Fn(&[Epoch]),
}

impl Fit<'_> {
    /// Trains `parameters` on `objective`, and returns the losses of all epochs. With early stopping, the parameters
    /// are then those of the best validation epoch, and otherwise those of the last epoch.
    ///
    /// # Errors
    /// When a loss is not finite, the state can't be saved or read, or the caller cancels.
    pub fn run(
        &self,
        objective: &dyn Objective,
        parameters: &Parameters,
    ) -> Result<Vec<Epoch>, LearningError> {
        let mut adam = Adam::new(parameters.values().cloned().collect(), self.training.learning_rate)?
            .with_weight_decay(self.training.weight_decay)
            .with_clip_norm(self.training.clip_norm);
        let mut state = self.state.resume(parameters, &mut adam, self.progress)?.unwrap_or_default();
        let mut steps = Steps::new(objective, adam, self.training.dropout);
        let stage = match self.task {
            Task::Prediction => "prediction",
            Task::Reconstruction => "reconstruction",
        };
        let epochs = self.training.final_epoch();
        self.progress.begin(stage, epochs as u64, "epochs");
        self.progress.resume(state.epochs.len() as u64);
        (self.log)(&state.epochs);
        while !self.finished(&state) {
            let epoch = match self.epoch(&mut steps, state.epochs.len()) {
                Err(LearningError::Cancelled) => {
                    self.state.save_kept(&state)?;
                    return Err(LearningError::Cancelled);
                }
                epoch => epoch?,
            };
            state.record(epoch, parameters)?;
            (self.log)(&state.epochs);
            self.progress.note(&describe(&state));
            self.progress.advance(1);
            self.state.save_now_and_then(&state, parameters, &steps.adam)?;
        }
        // The work after this training may be interrupted too.
        self.state.save_kept(&state)?;
        if self.training.patience.is_some() {
            state.restore_best(parameters)?;
        }
        self.progress.end();
        Ok(state.epochs)
    }

    /// Recalibrates the distributions that trained parameters predict, on the validation samples.
    ///
    /// # Errors
    /// When candle can't compute a loss.
    pub fn recalibrate(
        &self,
        objective: &dyn Objective,
        parameters: &Parameters,
        architecture: &Architecture,
    ) -> CandleResult<()> {
        architecture.recalibrate(parameters, &mut |score| match score {
            Score::Loss => self.validate(&*objective.detached()),
            Score::Intervals => self.validate(&*objective.intervals()),
        })
    }

    fn finished(&self, state: &State) -> bool {
        let done = state.epochs.len();
        let improved = match self.training.stop {
            Stop::Total => state.best_epoch(),
            Stop::EveryTerm => state.last_improvement(),
        };
        done >= self.training.final_epoch()
            || self.training.patience.is_some_and(|patience| done >= improved + patience)
    }

    fn epoch(&self, steps: &mut Steps, index: usize) -> Result<Epoch, LearningError> {
        let (begin, objective) = (Instant::now(), steps.objective);
        let mut random = Random::new(self.seed, Stream::Epoch { task: self.task, index });
        let mut missing = Random::new(self.seed, Stream::Missing { epoch: index });
        let mut order = sequences(&self.partition.training, objective.context(), |most| random.up_to(most));
        random.shuffle(&mut order);
        let mut train = Sums::default();
        let batch = self.windows_per_step(objective);
        let epoch_steps = order.len().div_ceil(batch);
        for (index, at) in order.chunks(batch).enumerate() {
            if self.progress.cancelled() {
                return Err(LearningError::Cancelled);
            }
            steps.adam.set_learning_rate(learning_rate(self.training, epoch_steps, steps.adam.steps()));
            train.add(steps.take(at, &mut random, &mut missing)?, at.len())?;
            self.progress.part(index as u64 + 1, epoch_steps as u64);
        }
        let validation = self.validate(&*objective.detached())?;
        let epoch = Epoch {
            epoch: index + 1,
            train: train.means()?,
            validation,
            seconds: begin.elapsed().as_secs_f64(),
        };
        self.check_finite(&epoch)?;
        Ok(epoch)
    }

    /// Returns the number of windows whose predicted samples are a batch.
    fn windows_per_step(&self, objective: &dyn Objective) -> usize {
        (self.training.batch_size / objective.predicted()).max(1)
    }

    /// Refuses an epoch with a loss that is infinite or NaN.
    fn check_finite(&self, epoch: &Epoch) -> Result<(), LearningError> {
        for (split, losses) in [("training", &epoch.train), ("validation", &epoch.validation)] {
            let mut losses = losses.clone();
            losses.retain(|_, value| !value.is_finite());
            if !losses.is_empty() {
                return Err(LearningError::NotFinite { task: self.task, epoch: epoch.epoch, split, losses });
            }
        }
        Ok(())
    }

    /// Returns the means of an objective's terms over the validation samples.
    fn validate(&self, objective: &dyn Objective) -> CandleResult<Losses> {
        let mut sums = Sums::default();
        let windows = sequences(&self.partition.validation, objective.context(), |most| most / 2);
        for at in windows.chunks(self.windows_per_step(objective)) {
            let losses = StepLosses::of(&objective.terms(at, Draw::Mean)?)?.0;
            sums.add(losses, at.len())?;
        }
        sums.means()
    }
}

/// Sums of a loss's terms over batches, weighted by the number of samples in each batch.
#[derive(Default)]
struct Sums {
    samples: f64,
    sums: Losses,
    /// The losses of the last batches, with the numbers of their samples. Reading one from a GPU waits for all work
    /// before it, so many are read at once.
    unread: Vec<(StepLosses, f64)>,
}

/// The number of batches whose losses are read at once.
const READ: usize = 256;

impl Sums {
    fn add(&mut self, losses: StepLosses, samples: usize) -> CandleResult<()> {
        self.samples += samples as f64;
        self.unread.push((losses, samples as f64));
        if self.unread.len() < READ { Ok(()) } else { self.read() }
    }

    fn read(&mut self) -> CandleResult<()> {
        let unread = std::mem::take(&mut self.unread);
        let values: Vec<&Tensor> = unread.iter().map(|(losses, _)| &losses.values).collect();
        let Some((first, _)) = unread.first() else { return Ok(()) };
        let values = Tensor::stack(&values, 0)?.to_vec2::<f32>()?;
        for (values, (_, samples)) in values.iter().zip(&unread) {
            for (name, value) in first.names.iter().zip(values) {
                *self.sums.entry(name.clone()).or_default() += f64::from(*value) * samples;
            }
        }
        Ok(())
    }

    fn means(mut self) -> CandleResult<Losses> {
        self.read()?;
        Ok(self.sums.into_iter().map(|(name, sum)| (name, sum / self.samples)).collect())
    }
}

/// Describes the last epoch's losses and the lowest validation loss so far.
fn describe(state: &State) -> String {
    let Some(last) = state.epochs.last() else { return String::new() };
    let of = |losses: &Losses| losses.get(TOTAL).copied().unwrap_or(f64::NAN);
    let best = &state.epochs[state.best_epoch() - 1];
    let lowest = if best.epoch == last.epoch {
        "lowest so far".into()
    } else {
        format!("lowest {:.4} in epoch {}", of(&best.validation), best.epoch)
    };
    format!("validation {:.4}, {lowest}, training {:.4}", of(&last.validation), of(&last.train))
}
