//! Modalities that do not change, which no metric of explained variance is defined for.

use super::{Partition, Sample, Samples, after, physical};
use harness_spec::{Modality, Window};

/// Number of samples whose values are compared at once.
const AT_ONCE: usize = 256;

/// What the values of a modality that does not change are.
#[derive(Clone, Copy, PartialEq)]
enum Constant {
    Zero,
    Other,
}

impl Samples {
    /// Returns a sentence for each of these outputs that is the same in all training or all test samples, such as
    /// `contact_force is 0 in all test samples, so its r2 is not defined`. Images that were not loaded are left out.
    pub fn constant_outputs(
        &self,
        outputs: &[Modality],
        partition: &Partition,
        window: &Window,
    ) -> Vec<String> {
        let sentence = |output: &Modality| {
            let definition = &self.layout[*output];
            let metric = match definition.is_image() {
                true => "relative_error",
                false if definition.unit_vectors => "angle",
                false => "r2",
            };
            let test = self.constant(*output, &after(&partition.test, window.first_horizon()));
            let training = self.constant(*output, &after(&partition.training, window.first_horizon()));
            let says = |constant| if constant == Constant::Zero { "is 0" } else { "does not change" };
            match (test, training) {
                // Categories that do not change have metrics, and so have directions.
                (Some(is), _)
                    if !definition.has_own_loss() || definition.unit_vectors && is == Constant::Zero =>
                {
                    Some(format!("{output} {} in all test samples, so its {metric} is not defined", says(is)))
                }
                (_, Some(is)) => Some(format!(
                    "{output} {} in all training samples, so no model can learn to predict it",
                    says(is)
                )),
                _ => None,
            }
        };
        let is_loaded = |output: &&Modality| !self.layout[**output].is_image() || self.has_frames();
        outputs.iter().filter(is_loaded).filter_map(sentence).collect()
    }

    /// Returns what a modality is if it is the same at all of these samples.
    fn constant(&self, modality: Modality, at: &[Sample]) -> Option<Constant> {
        let first = physical(self, modality, at.get(..1)?);
        let is_same = |at: &[Sample]| {
            physical(self, modality, at).chunks_exact(first.len()).all(|values| values == first)
        };
        let is_zero = first.iter().all(|value| *value == 0.0);
        at.chunks(AT_ONCE).all(is_same).then_some(if is_zero { Constant::Zero } else { Constant::Other })
    }
}
