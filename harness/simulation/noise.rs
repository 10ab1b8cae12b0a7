//! Noise of sensors: what is added to the recorded values of a modality if a factor of variation says so.

use super::factors::{FactorValues, stream};
use super::scene::Scene;
use harness_spec::Simulation;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

/// The noise of an episode, which is drawn anew at each sample.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct Noise {
    /// One for each factor of sensor noise that is on.
    sources: Vec<Source>,
}

/// The noise of a factor.
#[derive(Debug, Clone, PartialEq)]
struct Source {
    rng: ChaCha8Rng,
    /// The places of the modalities in the layout, with their standard deviations.
    deviations: Vec<(usize, f64)>,
}

impl Noise {
    /// Returns the noise with the standard deviations that an episode drew. Each factor has its own random stream.
    pub fn new(scene: &Scene, spec: &Simulation, factors: &FactorValues, episode: u32) -> Self {
        let source = |(name, deviations): (&str, _)| Source {
            rng: stream(&format!("{name} noise"), spec.stream(), scene.scenario(), episode),
            deviations,
        };
        Self { sources: factors.deviations(scene).map(source).collect() }
    }

    /// Draws the noise of a sample. `noise` has a list for each modality of the layout, which stays empty without
    /// noise. `widths` returns the number of values of a modality.
    pub fn draw(&mut self, widths: impl Fn(usize) -> usize, noise: &mut [Vec<f64>]) {
        for values in noise.iter_mut() {
            values.clear();
        }
        for Source { rng, deviations } in &mut self.sources {
            for (position, deviation) in deviations {
                let drawn = (0..widths(*position)).map(|_| {
                    let normal: f64 = StandardNormal.sample(rng);
                    *deviation * normal
                });
                let (values, drawn) = (&mut noise[*position], drawn.collect::<Vec<f64>>());
                // Noise of a second factor is added, and a deviation of zero leaves every bit as it is.
                if *deviation > 0.0 {
                    values.resize(drawn.len(), 0.0);
                    values.iter_mut().zip(drawn).for_each(|(value, drawn)| *value += drawn);
                }
            }
        }
    }
}
