//! Schedules the runs of a plan: over several jobs of this process, and beside other processes that use the same
//! results folder.

use super::training::TrainingRun;
use super::{ExperimentError, OpenData, Planned, PreparedData, Runner, Source, describe, training_bytes};
use crate::collection::check_missing;
use crate::turns::{Turn, Turns};
use harness_learning::open_device;
use harness_registry::{Claimed, Decision, LiveEpochs, Outcome, Provenance, RunRecord, Status};
use harness_shared::files::FolderLock;
use harness_shared::memory;
use harness_spec::{Division, Experiment, RunSpec, Task, Trained, World};
use std::collections::BTreeSet;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

/// Time between two checks whether another process has released a run, or another job its memory.
const POLL_INTERVAL: Duration = Duration::from_millis(500);

/// The outcome of an experiment's runs.
#[derive(Debug, Default)]
pub struct Summary {
    /// Number of runs that this call finished.
    pub done: usize,
    /// Number of runs that were done before, or by another process.
    pub skipped: usize,
    /// Number of trainings that this call finished and that continued a shorter one, by successive halving.
    pub continued: usize,
    /// Number of trials whose loss was no longer finite, now or before.
    pub diverged: usize,
    /// The failed runs, each with its reason. Each failure was reported when it happened, and is in the run's record if
    /// that could be written.
    pub failed: Vec<String>,
    /// Runs that were not waited for, since other processes work on them.
    pub held: usize,
    /// Runs that were left because one had failed.
    pub left: usize,
    /// Runs of other shares that successive halving has to compare with this share's.
    pub awaited: usize,
}

impl Summary {
    /// Adds the outcome of the next runs. Runs that were done before count once, with the first runs.
    fn add(&mut self, next: Summary) {
        self.done += next.done;
        self.continued += next.continued;
        self.diverged += next.diverged;
        self.failed.extend(next.failed);
        (self.held, self.left) = (next.held, next.left);
    }
}

/// The outcome of one run.
enum End {
    Done,
    Skipped,
    /// The loss of a trial was no longer finite.
    Diverged,
    /// The run failed. Holds its id and the reason.
    Failed(String),
    /// Another process is working on the run.
    Held,
    /// Nobody tried, because another run had failed.
    Left,
}

impl Runner<'_> {
    /// Performs every run of a plan that isn't done yet; a shard performs its share of them. A run that fails leaves a
    /// record with the reason, and the others continue, unless the runner fails fast. Runs that other processes are
    /// working on come last: if the runner waits, this call waits for them, and performs them if the other process
    /// dies.
    ///
    /// With successive halving, the runs up to a rung are compared when all of them are done, and the best are trained
    /// on. A process that has done its own share performs the runs that no other process works on, or ends if the
    /// runner does not wait. Returns the plan as it is at the end.
    ///
    /// # Errors
    /// When the caller cancels, no threads can be started, or images have to be rendered and can't be.
    pub fn run(
        &self,
        experiment: &Experiment,
        mut plan: Vec<Planned>,
    ) -> Result<(Summary, Vec<Planned>), ExperimentError> {
        let is_own = |index: usize| self.shard.is_none_or(|shard| shard.contains(index));
        let own: Vec<usize> = (0..plan.len()).filter(|index| is_own(*index)).collect();
        let is_halving = experiment.search.as_ref().is_some_and(|search| search.halving.is_some());
        let mut total = self.perform(own.into_iter().map(|index| &plan[index]).collect())?;
        if !is_halving {
            return Ok((total, plan));
        }
        loop {
            plan = self.planned(
                experiment,
                plan.into_iter().map(|planned| (planned.rungs, planned.source)).collect(),
            );
            plan.iter().for_each(|planned| self.tidy(planned));
            let pending: Vec<usize> = (0..plan.len()).filter(|index| !plan[*index].is_settled()).collect();
            let pending_own: Vec<usize> = pending.iter().copied().filter(|index| is_own(*index)).collect();
            if pending.is_empty() || !total.failed.is_empty() || total.held > 0 {
                return Ok((total, plan));
            }
            if pending_own.is_empty() && !self.waits {
                total.awaited = pending.len();
                return Ok((total, plan));
            }
            let wanted = if pending_own.is_empty() { pending } else { pending_own };
            total.add(self.perform(wanted.into_iter().map(|index| &plan[index]).collect())?);
        }
    }

    /// Removes what a run's shorter trainings have left, and the states of a run that is not trained on.
    fn tidy(&self, planned: &Planned) {
        if planned.decision == Decision::Skip {
            planned.earlier().for_each(|folder| self.registry.supersede(folder));
        }
        if planned.standing.is_last && planned.is_settled() {
            self.registry.remove_states(&planned.folder);
        }
    }

    /// Performs the given runs of a plan; see [`Runner::run`].
    fn perform(&self, plan: Vec<&Planned>) -> Result<Summary, ExperimentError> {
        let mut summary = Summary::default();
        let (settled, mut pending): (Vec<&Planned>, Vec<&Planned>) =
            plan.into_iter().partition(|planned| planned.is_settled());
        let (skipped, diverged): (Vec<&Planned>, Vec<&Planned>) =
            settled.into_iter().partition(|planned| planned.decision == Decision::Skip);
        (summary.skipped, summary.diverged) = (skipped.len(), diverged.len());
        // The process that finished them may have been killed before it removed their states.
        let unneeded = skipped.iter().filter(|planned| !planned.spec.may_continue());
        unneeded.for_each(|planned| self.registry.remove_states(&planned.folder));
        if pending.iter().any(|planned| planned.spec.split.by == Division::Sample) {
            self.progress.say(
                "split.by is sample: test samples have neighbors in the training data, so the errors are smaller \
                 than on new data",
            );
        }
        self.check_missing(&pending)?;
        let mut changed = BTreeSet::new();
        loop {
            let mut held = Vec::new();
            // One dataset is processed at a time, so that only its samples are in memory.
            for runs in by_data(pending) {
                if self.gives_up(&summary) {
                    summary.left += runs.len();
                    continue;
                }
                for (planned, end) in runs.iter().zip(self.work_on(&runs)?) {
                    match end {
                        End::Done if planned.standing.rung > 0 => summary.continued += 1,
                        End::Done => summary.done += 1,
                        End::Diverged => summary.diverged += 1,
                        End::Skipped => summary.skipped += 1,
                        End::Failed(failure) => summary.failed.push(failure),
                        End::Held => held.push(*planned),
                        End::Left => summary.left += 1,
                    }
                }
                self.say_if_changed(runs[0], &mut changed);
            }
            if held.is_empty() || !self.waits || self.gives_up(&summary) {
                summary.held = held.len();
                return Ok(summary);
            }
            self.wait(&held)?;
            pending = held;
        }
    }

    /// Checks that the episodes that runs need can be simulated, so that a missing driver is reported once.
    fn check_missing(&self, pending: &[&Planned]) -> Result<(), ExperimentError> {
        let mut sources: Vec<&Arc<Source>> = pending.iter().map(|planned| &planned.source).collect();
        sources.dedup_by(|a, b| Arc::ptr_eq(a, b));
        let datasets = sources.into_iter().flat_map(|source| source.simulated());
        Ok(check_missing(datasets.map(|(dataset, _)| dataset))?)
    }

    /// Whether no further run is tried, because one failed.
    fn gives_up(&self, summary: &Summary) -> bool {
        self.fails_fast && !summary.failed.is_empty()
    }

    /// Reports, once for each world, that its files have changed since the plan was made.
    fn say_if_changed(&self, run: &Planned, said: &mut BTreeSet<String>) {
        for label in run.source.changed_worlds().map(World::label) {
            if said.insert(label.to_owned()) {
                self.progress.say(&format!(
                    "{label}, its model, or a file of the model has changed since this command began; its runs use the \
                     old version, and running the same command again makes those of the new version"
                ));
            }
        }
    }

    /// Tries to perform runs that share their data, and returns the outcome of each.
    fn work_on(&self, runs: &[&Planned]) -> Result<Vec<End>, ExperimentError> {
        let jobs = self.jobs.clamp(1, runs.len());
        let threads = (self.threads / jobs).max(1);
        let workers = WorkerPool {
            runner: self,
            provenance: Provenance { threads, ..self.provenance.clone() },
            runs,
            turns: self.shard.and_then(|_| Turns::new(&std::env::temp_dir(), threads)),
            said_waiting: AtomicBool::new(false),
            next: AtomicUsize::new(0),
            prepared: Mutex::new(None),
            promised: Mutex::new(0),
            failed: AtomicBool::new(false),
        };
        // A job runs in its own pool. From outside of a pool, each parallel operation would wait for a change of
        // threads.
        let pools = (0..jobs)
            .map(|_| rayon::ThreadPoolBuilder::new().num_threads(threads).build())
            .collect::<Result<Vec<_>, _>>()?;
        let ends: Vec<_> = std::thread::scope(|scope| {
            let workers: Vec<_> =
                pools.iter().map(|pool| scope.spawn(|| pool.install(|| workers.work()))).collect();
            let joined = workers.into_iter().map(|worker| worker.join());
            joined.map(|end| end.unwrap_or_else(|panic| std::panic::resume_unwind(panic))).collect()
        });
        let mut ends: Vec<_> =
            ends.into_iter().collect::<Result<Vec<_>, _>>()?.into_iter().flatten().collect();
        ends.sort_by_key(|(index, _)| *index);
        Ok(ends.into_iter().map(|(_, end)| end).collect())
    }

    /// Waits until another process has released one of the runs.
    fn wait(&self, held: &[&Planned]) -> Result<(), ExperimentError> {
        let holder = |planned: &&Planned| FolderLock::holder(planned.folder.path());
        for (planned, holder) in held.iter().filter_map(|planned| Some((planned, holder(planned)?))) {
            self.progress.say(&format!("waiting for {}, which {holder} is working on", planned.folder.id()));
        }
        while held.iter().all(|planned| holder(planned).is_some()) {
            if self.progress.cancelled() {
                return Err(ExperimentError::Cancelled);
            }
            std::thread::sleep(POLL_INTERVAL);
        }
        Ok(())
    }
}

/// Groups runs that share their data. The groups have the order of their first runs.
fn by_data(runs: Vec<&Planned>) -> Vec<Vec<&Planned>> {
    let mut groups: Vec<Vec<&Planned>> = Vec::new();
    for run in runs {
        match groups.iter_mut().rev().find(|group| group[0].shares_data(run)) {
            Some(group) => group.push(run),
            None => groups.push(vec![run]),
        }
    }
    groups
}

/// The state that is shared by the jobs that work on runs of the same data.
struct WorkerPool<'a> {
    runner: &'a Runner<'a>,
    /// Has the number of threads of one job.
    provenance: Provenance,
    runs: &'a [&'a Planned],
    /// The turns that this process takes at training; `None` if it trains beside all others.
    turns: Option<Turns>,
    /// Whether it was reported that this process waits for a turn.
    said_waiting: AtomicBool,
    /// Index of the next run.
    next: AtomicUsize,
    /// The prepared data, or why they can't be prepared. The first job that needs them prepares them.
    prepared: Mutex<Option<Result<Arc<PreparedData>, String>>>,
    /// Memory that is reserved for the current trainings, bytes.
    promised: Mutex<u64>,
    /// Whether a run failed.
    failed: AtomicBool,
}

/// Reserves memory for one training until it is dropped.
struct Promise<'a> {
    promised: &'a Mutex<u64>,
    bytes: u64,
}

impl Drop for Promise<'_> {
    fn drop(&mut self) {
        *self.promised.lock().unwrap_or_else(PoisonError::into_inner) -= self.bytes;
    }
}

impl WorkerPool<'_> {
    /// Takes runs one after the other until none is left.
    fn work(&self) -> Result<Vec<(usize, End)>, ExperimentError> {
        let mut ends = Vec::new();
        loop {
            let index = self.next.fetch_add(1, Ordering::Relaxed);
            let Some(planned) = self.runs.get(index) else { return Ok(ends) };
            if self.runner.progress.cancelled() {
                return Err(ExperimentError::Cancelled);
            }
            if self.runner.fails_fast && self.failed.load(Ordering::Relaxed) {
                ends.push((index, End::Left));
                continue;
            }
            let _turn = self.turn()?;
            let end = match self.attempt(planned) {
                Err(error) if !error.is_cancelled() => {
                    self.failed.store(true, Ordering::Relaxed);
                    End::Failed(self.say_failed(planned, &describe(&error)))
                }
                end => end?,
            };
            ends.push((index, end));
        }
    }

    /// Waits for a turn at training, if this process is one of several that divide the runs. More of them than fit on
    /// the cores take longer at the same time than one after the other.
    fn turn(&self) -> Result<Option<Turn>, ExperimentError> {
        let Some(turns) = &self.turns else { return Ok(None) };
        let progress = self.runner.progress;
        let turn = turns.take(|| {
            if !self.said_waiting.swap(true, Ordering::Relaxed) {
                progress.say("waiting until another shard on this machine has finished a run");
            }
            !progress.cancelled()
        });
        turn.map(Some).ok_or(ExperimentError::Cancelled)
    }

    fn attempt(&self, planned: &Planned) -> Result<End, ExperimentError> {
        let Planned { spec, folder, .. } = planned;
        let registry = self.runner.registry;
        let Some(claimed) = registry.claim(folder)? else { return Ok(End::Held) };
        if planned.is_outdated() {
            claimed.supersede();
            return Ok(End::Skipped);
        }
        // Another process may have worked on the run since the plan was made.
        match folder.record() {
            Ok(Some(record)) if record.status == Status::Done => match record.damage(folder.path()) {
                None => return Ok(End::Skipped),
                Some(damage) => {
                    self.runner.progress.say(&format!("{}: {damage}; the run starts again", folder.id()));
                }
            },
            Ok(Some(record))
                if record.status == Status::Failed && planned.record.as_ref() != Some(&record) =>
            {
                if record.diverged {
                    return Ok(End::Diverged);
                }
                let reason = record.reason.unwrap_or_default();
                return Ok(End::Failed(self.say_failed(planned, &format!("{reason} (in another process)"))));
            }
            _ => {}
        }
        let provenance = planned.source.provenance(&self.provenance);
        let record = claimed.begin(spec, planned.layout(), &provenance)?;
        let record = RunRecord { place: planned.place, ..record };
        planned.earlier().any(|earlier| claimed.take_state(earlier, Task::Prediction));
        let end =
            self.train(planned, &claimed).and_then(|outcome| Ok(claimed.finish(record.clone(), &outcome)?));
        let diverged = spec.trial().is_some() && end.as_ref().is_err_and(ExperimentError::is_divergence);
        if let Err(error) = &end
            && !error.is_cancelled()
            && let Err(second) = claimed.fail(RunRecord { diverged, ..record }, &describe(error))
        {
            self.say_failed(planned, &format!("its record can't be written: {}", describe(&second)));
        }
        if diverged {
            self.runner.progress.say(&format!("{} diverged: it is the worst of the trials", folder.id()));
            return Ok(End::Diverged);
        }
        end?;
        planned.earlier().for_each(|earlier| registry.supersede(earlier));
        Ok(End::Done)
    }

    fn train(&self, planned: &Planned, claimed: &Claimed) -> Result<Outcome, ExperimentError> {
        let trained = planned.spec.trained().ok_or_else(|| {
            ExperimentError::NotTrained(
                "this run's model is one of another program, which the harness can't train".to_owned(),
            )
        })?;
        let prepared = self.prepared(planned)?;
        let _memory = self.promise(&planned.spec, trained, &prepared)?;
        let everyone = self.runner.progress;
        let spec = &planned.spec;
        let own = everyone.job(&spec.label());
        let progress = own.as_deref().unwrap_or(everyone);
        let epochs = LiveEpochs::of(claimed);
        let OpenData { data, partition, .. } = &prepared.open;
        let mut data = data.on(open_device(trained.training.device)?);
        let changes = &trained.training.predict;
        if !changes.is_empty() {
            data = data.predicting_changes(changes.keys().copied(), &partition.training, spec.window.horizon);
        }
        TrainingRun { spec, trained, claimed, prepared: &prepared, data, progress, epochs }.run()
    }

    /// Reserves memory to train a run. Waits while other jobs' trainings use it. Without this check, the system would
    /// kill the process and all of its runs when memory runs out.
    fn promise(
        &self,
        spec: &RunSpec,
        trained: &Trained,
        prepared: &PreparedData,
    ) -> Result<Promise<'_>, ExperimentError> {
        let needed = training_bytes(spec, trained, prepared.open.data.samples.layout())?;
        loop {
            let mut promised = self.promised.lock().unwrap_or_else(PoisonError::into_inner);
            let available =
                memory::within_reach().saturating_sub(prepared.open.bytes).saturating_sub(*promised);
            if needed <= available {
                *promised += needed;
                return Ok(Promise { promised: &self.promised, bytes: needed });
            }
            if *promised == 0 {
                return Err(ExperimentError::NotTrained(format!(
                    "the network takes up to {:.1} GB of memory to train and only {:.1} GB are free; free some, or \
                     lower network.hidden, network.channels or training.batch_size",
                    needed as f64 / 1e9,
                    available as f64 / 1e9
                )));
            }
            drop(promised);
            if self.runner.progress.cancelled() {
                return Err(ExperimentError::Cancelled);
            }
            std::thread::sleep(POLL_INTERVAL);
        }
    }

    /// Returns the data that the runs share. Other jobs wait while the data are being prepared.
    fn prepared(&self, planned: &Planned) -> Result<Arc<PreparedData>, ExperimentError> {
        let mut slot = self.prepared.lock().unwrap_or_else(PoisonError::into_inner);
        if self.runner.progress.cancelled() {
            return Err(ExperimentError::Cancelled);
        }
        let made = match slot.take() {
            Some(made) => made,
            None => match self.runner.prepare(planned) {
                Err(error) if error.is_cancelled() => return Err(error),
                made => made.map(Arc::new).map_err(|error| describe(&error)),
            },
        };
        slot.insert(made).clone().map_err(ExperimentError::NotTrained)
    }

    /// Reports that a run failed, and returns the message.
    fn say_failed(&self, planned: &Planned, reason: &str) -> String {
        let failure = format!("{} failed: {reason}", planned.folder.id());
        self.runner.progress.say(&failure);
        failure
    }
}
