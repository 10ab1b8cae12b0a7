//! Many live simulations, stepped in parallel.

use super::SimulationError;
use super::live::LiveSimulation;
use super::scene::Scene;
use harness_spec::{Modality, Simulation};
use rayon::prelude::*;

/// The most simulations of a batch: beyond any use, and far below what memory holds.
const MAX_BATCH: usize = 4096;

/// Simulations of one scene that are independent of each other. Each takes part of the work of the caller's
/// rayon pool; a single one stays on the caller's thread, and needs no pool.
pub struct Batch {
    simulations: Vec<LiveSimulation>,
}

impl Batch {
    /// `count` simulations, each at the start of the spec's first episode.
    ///
    /// # Errors
    /// When `count` is 0 or too large, or as [`LiveSimulation::new`].
    pub fn new(scene: &'static Scene, spec: &Simulation, count: usize) -> Result<Self, SimulationError> {
        if !(1..=MAX_BATCH).contains(&count) {
            return Err(SimulationError::Batch(format!(
                "count: a batch holds 1 to {MAX_BATCH} simulations, not {count}"
            )));
        }
        let simulations = (0..count).map(|_| LiveSimulation::new(scene, spec));
        Ok(Self { simulations: simulations.collect::<Result<_, _>>()? })
    }

    /// Its simulations, at least one.
    pub fn simulations(&self) -> &[LiveSimulation] {
        &self.simulations
    }

    /// Takes a simulation to the start of an episode, as [`LiveSimulation::reset`].
    ///
    /// # Errors
    /// When there is no simulation of that index, and as [`LiveSimulation::reset`].
    pub fn reset(&mut self, index: usize, seed: u64, episode: u32) -> Result<(), SimulationError> {
        let count = self.simulations.len();
        let simulation = self.simulations.get_mut(index).ok_or_else(|| {
            SimulationError::Batch(format!(
                "index: the batch holds simulations 0 to {}, not {index}",
                count - 1
            ))
        })?;
        simulation.reset(seed, episode)
    }

    /// Takes each simulation to its next sample, as [`LiveSimulation::step`], those apart that are not `active`.
    ///
    /// # Errors
    /// When there are not as many setpoints as simulations, and as [`LiveSimulation::step`]; the others have been
    /// stepped then.
    pub fn step(&mut self, setpoints: &[Vec<f64>], active: &[bool]) -> Result<(), SimulationError> {
        let count = self.simulations.len();
        for (name, found) in [("setpoints", setpoints.len()), ("active", active.len())] {
            if found != count {
                return Err(SimulationError::Batch(format!("{name}: {found} for {count} simulations")));
            }
        }
        self.each(|index, simulation| match active[index] {
            true => simulation.step(&setpoints[index]),
            false => Ok(()),
        })
    }

    /// Takes each simulation to its next sample along its episode's own plan.
    ///
    /// # Errors
    /// When one diverges.
    pub fn follow(&mut self) -> Result<(), SimulationError> {
        self.each(|_, simulation| simulation.follow())
    }

    /// A camera's images, `[count, rows, columns, 3]`, written to `frames`.
    ///
    /// # Errors
    /// As [`LiveSimulation::image`].
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

    /// Works on each simulation; the first error is that of the lowest index.
    fn each(
        &mut self,
        work: impl Fn(usize, &mut LiveSimulation) -> Result<(), SimulationError> + Sync,
    ) -> Result<(), SimulationError> {
        let ends: Vec<_> = match self.simulations.as_mut_slice() {
            [simulation] => vec![work(0, simulation)],
            // Contacts make one simulation's step several times as long as another's, so each is dealt out by itself.
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
