//! Simulates the missing episodes of a dataset in parallel.

use crate::ExperimentError;
use crate::shard::Shard;
use harness_registry::dataset::{CompiledModel, Dataset, DatasetError};
use harness_shared::files::{FolderLock, LockError};
use harness_shared::progress::Progress;
use harness_simulation::{Scene, SimulationError, Simulator, mujoco_version, refuse_policy, rendering};
use harness_spec::Simulation;
use std::ops::ControlFlow;
use std::path::Path;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

/// Time between two attempts to lock a dataset that another process has locked.
const POLL_INTERVAL: Duration = Duration::from_millis(100);

/// Returns the dataset of a scene and a spec in the folder `root`. It reads and writes nothing.
pub fn dataset_of(root: &Path, scene: &Scene, spec: &Simulation) -> Dataset {
    let layout = scene.layout_of(spec);
    let model = CompiledModel {
        layout: &layout,
        sha256: scene.model_sha256(),
        mujoco_version: mujoco_version(),
        course_sha256: scene.course_sha256(),
        rule: scene.rule(),
    };
    Dataset::new(root, scene.world(), model, spec)
}

/// Checks that the missing episodes of datasets can be simulated here.
///
/// # Errors
/// When a policy gives the setpoints of missing episodes, or they have images and there is no OpenGL to render with.
pub fn check_missing<'a>(datasets: impl IntoIterator<Item = &'a Dataset>) -> Result<(), SimulationError> {
    let mut has_images = false;
    let is_incomplete = |dataset: &&Dataset| dataset.files() < dataset.spec().episodes as usize;
    for dataset in datasets.into_iter().filter(is_incomplete) {
        refuse_policy(dataset.spec())?;
        has_images |= dataset.layout().stored_images().next().is_some();
    }
    if has_images {
        rendering()?;
    }
    Ok(())
}

/// Locks a dataset's folder, and describes the dataset in it. Returns the lock, and the indices of the missing
/// episodes. The caller writes them before it drops the lock.
///
/// If other processes collect the same dataset, it waits for them.
///
/// # Errors
/// When the folder can't be locked or written, or the caller cancels.
pub fn claim(
    dataset: &Dataset,
    scene: &Scene,
    progress: &dyn Progress,
) -> Result<(FolderLock, Vec<u32>), DatasetError> {
    let lock = lock(dataset, FolderLock::attempt, progress)?;
    dataset.describe(|| scene.mjcf())?;
    Ok((lock, dataset.to_make(progress)))
}

/// Simulates the missing episodes of `dataset` and returns their number. Each of the `threads` threads has its own
/// simulator and renderer, and writes each episode when it is finished.
///
/// If other processes collect the same dataset, it waits for them.
///
/// # Errors
/// When an episode can't be simulated or written, or the caller cancels. The other threads then stop at their next
/// sample. Episodes that are already written are kept.
pub fn collect(
    dataset: &Dataset,
    scene: &Scene,
    threads: usize,
    progress: &dyn Progress,
) -> Result<usize, ExperimentError> {
    let (_lock, missing) = claim(dataset, scene, progress)?;
    make(dataset, scene, &missing, threads, progress)
}

/// Like [`collect`], but simulates only the episodes of one shard. The shards divide a list in which the dataset's
/// first episode has the index `first`. Other processes can simulate the other shards at the same time.
pub fn collect_share(
    dataset: &Dataset,
    scene: &Scene,
    shard: Shard,
    first: usize,
    threads: usize,
    progress: &dyn Progress,
) -> Result<usize, ExperimentError> {
    share(dataset, scene, shard, first, threads, progress).map(|(made, _)| made)
}

/// Like [`collect`], together with other processes: first the episodes of a shard, then those that the other processes
/// have not simulated.
pub fn collect_together(
    dataset: &Dataset,
    scene: &Scene,
    shard: Shard,
    threads: usize,
    progress: &dyn Progress,
) -> Result<usize, ExperimentError> {
    match share(dataset, scene, shard, 0, threads, progress)? {
        (_, 0) => Ok(0),
        (made, _) => Ok(made + collect(dataset, scene, threads, progress)?),
    }
}

/// Simulates the missing episodes of a shard. Returns their number, and that of all missing episodes.
fn share(
    dataset: &Dataset,
    scene: &Scene,
    shard: Shard,
    first: usize,
    threads: usize,
    progress: &dyn Progress,
) -> Result<(usize, usize), ExperimentError> {
    let _lock = lock(dataset, FolderLock::attempt_shared, progress)?;
    dataset.describe(|| scene.mjcf())?;
    let missing = dataset.to_make(progress);
    let of_shard = |episode: &u32| shard.contains(first + *episode as usize);
    let own: Vec<u32> = missing.iter().copied().filter(of_shard).collect();
    Ok((make(dataset, scene, &own, threads, progress)?, missing.len()))
}

/// Simulates the episodes `missing` of a dataset whose folder the caller has locked.
fn make(
    dataset: &Dataset,
    scene: &Scene,
    missing: &[u32],
    threads: usize,
    progress: &dyn Progress,
) -> Result<usize, ExperimentError> {
    if missing.is_empty() {
        return Ok(0);
    }
    let samples = missing.len() * dataset.spec().samples_per_episode();
    progress.begin(&format!("collecting {}", scene.scenario()), samples as u64, "samples");
    let work =
        Work { dataset, scene, missing, next: AtomicUsize::new(0), failure: Mutex::new(None), progress };
    std::thread::scope(|scope| {
        let spawn = |_| scope.spawn(|| work.take_part());
        let workers: Vec<_> = (0..threads.clamp(1, missing.len())).map(spawn).collect();
        // A scope does not wait until its threads have freed their thread-local memory, as OpenGL drivers do at a
        // thread's end. If the process exits meanwhile, both free the same memory. Joining the threads prevents this.
        for worker in workers {
            worker.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic));
        }
    });
    progress.end();
    match work.failure.into_inner().unwrap_or_else(|poisoned| poisoned.into_inner()) {
        Some(error) => Err(error),
        None => Ok(missing.len()),
    }
}

/// Locks the dataset's folder. It repeats `attempt` until it succeeds or the caller cancels.
fn lock(
    dataset: &Dataset,
    attempt: fn(&Path) -> Result<Option<FolderLock>, LockError>,
    progress: &dyn Progress,
) -> Result<FolderLock, DatasetError> {
    let mut said = false;
    loop {
        if let Some(lock) = attempt(dataset.folder())? {
            return Ok(lock);
        }
        if !said {
            let holder = FolderLock::holder(dataset.folder());
            let holder = holder.map_or("other processes, which collect shares of".into(), |holder| {
                format!("{holder}, which collects")
            });
            progress.say(&format!("waiting for {holder} {}", dataset.name()));
            said = true;
        }
        if progress.cancelled() {
            return Err(DatasetError::Cancelled);
        }
        std::thread::sleep(POLL_INTERVAL);
    }
}

/// The data that the threads share.
struct Work<'a> {
    dataset: &'a Dataset,
    scene: &'a Scene,
    missing: &'a [u32],
    next: AtomicUsize,
    failure: Mutex<Option<ExperimentError>>,
    progress: &'a dyn Progress,
}

impl Work<'_> {
    /// Simulates episodes until none is left or one fails.
    fn take_part(&self) {
        if let Err(error) = self.make_episodes() {
            self.failure.lock().unwrap_or_else(|poisoned| poisoned.into_inner()).get_or_insert(error);
        }
    }

    fn stopping(&self) -> bool {
        self.progress.cancelled() || self.failure.lock().is_ok_and(|failure| failure.is_some())
    }

    fn make_episodes(&self) -> Result<(), ExperimentError> {
        let mut simulator = Simulator::new(self.scene, self.dataset.spec())?;
        while let Some(index) = self.missing.get(self.next.fetch_add(1, Ordering::Relaxed)) {
            let episode = simulator.run(*index, &mut || {
                self.progress.advance(1);
                if self.stopping() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
            })?;
            self.dataset.save(&episode)?;
        }
        Ok(())
    }
}
