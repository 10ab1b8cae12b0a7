//! Steps many live simulations in parallel.

use super::SimulationError;
use super::live::LiveSimulation;
use super::scene::Scene;
use harness_spec::{Modality, Simulation};
use rayon::prelude::*;

/// Largest number of simulations in a batch. It is more than anyone needs, and fits into memory.
const MAX_BATCH: usize = 4096;

/// Independent simulations of one scene. They run in parallel on the caller's rayon pool. A single simulation runs on
/// the caller's thread, without a pool.
pub struct Batch {
    simulations: Vec<LiveSimulation>,
}

impl Batch {
    /// Creates `count` simulations, each at the start of the spec's first episode.
    ///
    /// # Errors
    /// When `count` is 0 or above 4096, and for the reasons of [`LiveSimulation::new`].
    pub fn new(scene: &'static Scene, spec: &Simulation, count: usize) -> Result<Self, SimulationError> {
        if !(1..=MAX_BATCH).contains(&count) {
            return Err(SimulationError::Argument(format!(
                "count: a batch holds 1 to {MAX_BATCH} simulations, not {count}"
            )));
        }
        let simulations = (0..count).map(|_| LiveSimulation::new(scene, spec));
        Ok(Self { simulations: simulations.collect::<Result<_, _>>()? })
    }

    /// Returns the simulations; there is at least one.
    pub fn simulations(&self) -> &[LiveSimulation] {
        &self.simulations
    }

    /// Resets one simulation to the start of an episode, like [`LiveSimulation::reset`].
    ///
    /// # Errors
    /// When there is no simulation with that index, and for the reasons of [`LiveSimulation::reset`].
    pub fn reset(&mut self, index: usize, seed: u64, episode: u32) -> Result<(), SimulationError> {
        let count = self.simulations.len();
        let simulation = self.simulations.get_mut(index).ok_or_else(|| {
            SimulationError::Argument(format!(
                "index: the batch has simulations 0 to {}, not {index}",
                count - 1
            ))
        })?;
        simulation.reset(seed, episode)
    }

    /// Advances each `active` simulation to its next sample, like [`LiveSimulation::step`].
    ///
    /// # Errors
    /// When the number of setpoints or of `active` values differs from the number of simulations, and for the reasons
    /// of [`LiveSimulation::step`]. If one simulation fails, the others have still been stepped.
    pub fn step(&mut self, setpoints: &[Vec<f64>], active: &[bool]) -> Result<(), SimulationError> {
        let count = self.simulations.len();
        for (name, found) in [("setpoints", setpoints.len()), ("active", active.len())] {
            if found != count {
                return Err(SimulationError::Argument(format!("{name}: {found} for {count} simulations")));
            }
        }
        self.each(|index, simulation| match active[index] {
            true => simulation.step(&setpoints[index]),
            false => Ok(()),
        })
    }

    /// Advances each simulation to its next sample along the plan of its episode.
    pub fn follow(&mut self) -> Result<(), SimulationError> {
        self.each(|_, simulation| simulation.follow())
    }

    /// Writes a camera's images, `[count, rows, columns, 3]`, to `frames`.
    pub fn image(&mut self, modality: Modality, frames: &mut [u8]) -> Result<(), SimulationError> {
        let size = frames.len() / self.simulations.len();
        match self.simulations.as_mut_slice() {
            [simulation] => simulation.image(modality, frames),
            several => several
                .par_iter_mut()
                .zip(frames.par_chunks_exact_mut(size))
                .try_for_each(|(simulation, frame)| simulation.image(modality, frame)),
        }
    }

    /// Calls `work` for each simulation. If several fail, it returns the error of the lowest index.
    fn each(
        &mut self,
        work: impl Fn(usize, &mut LiveSimulation) -> Result<(), SimulationError> + Sync,
    ) -> Result<(), SimulationError> {
        let ends: Vec<_> = match self.simulations.as_mut_slice() {
            [simulation] => vec![work(0, simulation)],
            // Contacts can make one simulation's step several times as long as another's, so each one is its own task.
            several => several
                .par_iter_mut()
                .enumerate()
                .with_max_len(1)
                .map(|(index, simulation)| work(index, simulation))
                .collect(),
        };
        let failed = ends.into_iter().enumerate().find_map(|(index, end)| Some((index, end.err()?)));
        match failed {
            Some((index, SimulationError::Setpoint { setpoint, expected, .. })) => {
                Err(SimulationError::Setpoint { index, setpoint, expected })
            }
            Some((_, error)) => Err(error),
            None => Ok(()),
        }
    }
}
