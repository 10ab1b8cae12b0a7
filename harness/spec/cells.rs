//! The runs that an experiment expands to. All that decides one run's result is in its [`RunSpec`].

use super::types::{Action, Experiment, Modality, Network, Scenario, Simulation, Split, Task, Training};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

/// One run: a cell (scenario, modalities, latent size, network) with one seed. It holds everything that
/// decides the result and nothing that does not, so runs of different experiments with equal specs are equal.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunSpec {
    pub scenario: Scenario,
    /// What the encoder is given, in the order of [`Modality`].
    pub input: Vec<Modality>,
    /// What the decoder predicts, in the order of [`Modality`].
    pub output: Vec<Modality>,
    /// Size of the latent state.
    pub latent: usize,
    /// Seed of the initial weights, the sampling and the order of batches.
    pub seed: u64,
    /// What is trained, in this order.
    pub tasks: Vec<Task>,
    pub action: Action,
    pub network: Network,
    pub simulation: Simulation,
    pub split: Split,
    pub training: Training,
}

impl Experiment {
    /// The runs by scenario, then latent size, then seed, each in the spec's order.
    pub fn runs(&self) -> Vec<RunSpec> {
        let mut runs = Vec::with_capacity(self.scenarios.len() * self.latent.len() * self.seeds.len());
        for &scenario in &self.scenarios {
            for &latent in &self.latent {
                runs.extend(self.seeds.iter().map(|&seed| self.run(scenario, latent, seed)));
            }
        }
        runs
    }

    fn run(&self, scenario: Scenario, latent: usize, seed: u64) -> RunSpec {
        RunSpec {
            scenario,
            input: self.input.clone(),
            output: self.output.clone(),
            latent,
            seed,
            tasks: self.tasks.clone(),
            action: self.action,
            network: self.network.clone(),
            simulation: self.simulation.clone(),
            split: self.split.clone(),
            training: self.training.clone(),
        }
    }
}

impl RunSpec {
    /// Identifies the run: 16 hexadecimal digits of the SHA-256 of its JSON with keys sorted. It does not
    /// depend on how the YAML was laid out, nor on which values were left to their defaults.
    pub fn hash(&self) -> String {
        let mut json = serde_json::to_value(self).expect("a run's spec is plain data");
        json.sort_all_objects();
        let digest = Sha256::digest(json.to_string());
        digest.iter().take(8).map(|byte| format!("{byte:02x}")).collect()
    }

    /// The run's spec as YAML with every value explicit.
    pub fn to_yaml(&self) -> String {
        serde_yaml::to_string(self).expect("a run's spec is plain data, which YAML can hold")
    }

    /// The cell in short, `cluttered-z64`; unique within an experiment.
    pub fn cell(&self) -> String {
        format!("{}-z{}", self.scenario, self.latent)
    }

    /// The run in short, `cluttered-z64-seed0`; unique within an experiment.
    pub fn label(&self) -> String {
        format!("{}-seed{}", self.cell(), self.seed)
    }
}
