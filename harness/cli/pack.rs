//! `harness pack` and `harness unpack`.

use super::progress::Bars;
use super::table::{print_command, print_text};
use super::{DONE, interrupt};
use anyhow::Result;
use clap::Args;
use harness::collection::dataset_of;
use harness::experiment::describe;
use harness::files::write_bytes;
use harness::numbers::{bytes, counted};
use harness::registry::{Recorded, Registry, RunRecord, Status, Versions, path_word};
use harness::simulation::{Scene, mujoco_version};
use harness::spec::parse_task;
use harness::transfer::{self, PackError, Packed};
use std::path::PathBuf;
use std::process::ExitCode;

#[derive(Args)]
pub struct Pack {
    /// Experiments, ids, EXPERIMENT/ID or folders. A beginning of an id stands for every run that begins with it
    #[arg(required = true, value_name = "RUN")]
    runs: Vec<String>,
    /// The file to write. It must not exist
    #[arg(long, short, value_name = "FILE")]
    output: PathBuf,
    /// Also pack the datasets that the runs used
    #[arg(long)]
    datasets: bool,
}

impl Pack {
    pub fn execute(self, registry: &Registry) -> Result<ExitCode> {
        let mut chosen: Vec<Recorded> = Vec::new();
        for wanted in &self.runs {
            for (folder, record) in registry.matching(wanted)? {
                if !chosen.iter().any(|(other, _)| *other == folder) {
                    chosen.push((folder, record));
                }
            }
        }
        interrupt::install()?;
        let versions = Versions { mujoco: mujoco_version(), candle: harness::learning::CANDLE_VERSION };
        let packed =
            transfer::pack(registry, &chosen, self.datasets, versions, &self.output, &Bars::default())?;
        for (_, record) in chosen.iter().filter(|(_, record)| record.status != Status::Done) {
            eprintln!("{} is left out: it is {}", record.name(), record.status.name());
        }
        let Packed { runs, datasets, files, bytes: size } = packed;
        let datasets =
            if self.datasets { counted(datasets, "dataset") } else { "without their datasets".into() };
        let (runs, files, size) = (counted(runs, "run"), counted(files, "file"), bytes(size));
        print_text(&format!("{runs}, {datasets}: {files}, {size} in {}", self.output.display()));
        let command = format!("harness unpack {}", path_word(&self.output));
        print_command("unpack it with: ", &command);
        Ok(ExitCode::from(DONE))
    }
}

#[derive(Args)]
pub struct Unpack {
    /// A file that `harness pack` wrote
    #[arg(value_name = "FILE")]
    pack: PathBuf,
}

impl Unpack {
    pub fn execute(self, registry: &Registry) -> Result<ExitCode> {
        interrupt::install()?;
        let unpacked = transfer::unpack(registry, &self.pack, &Bars::default())?;
        let (runs, datasets) = (counted(unpacked.runs, "run"), counted(unpacked.datasets, "dataset"));
        let (root, same) = (registry.root().display(), unpacked.same);
        print_text(&format!("{runs} and {datasets} unpacked into {root}, {same} were there before"));
        for record in &unpacked.lacking {
            let lacking = format!("dataset {} is not here. To predict its samples, ", record.dataset);
            match collection_of(registry, record) {
                Ok(spec) => {
                    print_text(&format!("{lacking}collect the same samples with:"));
                    print_command("  ", &registry.command(&format!("collect {}", path_word(&spec))));
                }
                Err(reason) => print_text(&format!(
                    "{lacking}pack it with `harness pack --datasets` where it is. It can't be collected here: {reason}"
                )),
            }
        }
        print_command("list them with: ", &registry.command("ls"));
        Ok(ExitCode::from(DONE))
    }
}

/// Writes a spec with which `harness collect` simulates a run's dataset, and returns its path.
///
/// # Errors
/// When this program can't simulate the dataset. Returns the reason.
fn collection_of(registry: &Registry, record: &RunRecord) -> Result<PathBuf, String> {
    if record.spec.simulation.is_none() {
        return Err("it was imported".into());
    }
    let path = registry.dataset_spec(&record.dataset);
    let text = record.spec.to_experiment_yaml(&record.experiment);
    if !makes(&text, record, registry) {
        let by = &record.provenance;
        return Err(format!(
            "the world {} is not built in, or was another one in harness {} with MuJoCo {}",
            record.spec.scenario, by.harness_version, by.mujoco_version
        ));
    }
    write_bytes(&path, text.as_bytes()).map_err(|error| describe(&error))?;
    Ok(path)
}

/// Whether the dataset of a spec is that of a run.
fn makes(spec: &str, record: &RunRecord, registry: &Registry) -> bool {
    let Ok(experiment) = parse_task("spec", spec) else { return false };
    experiment.simulated().into_iter().any(|(world, simulation)| {
        Scene::new(world).is_ok_and(|scene| {
            scene.check(&simulation).is_ok()
                && dataset_of(&registry.datasets(), &scene, &simulation).name() == record.dataset
        })
    })
}

/// Whether an error is the user's.
pub fn is_usage(error: &anyhow::Error) -> bool {
    matches!(
        error.downcast_ref(),
        Some(
            PackError::Exists(_)
                | PackError::NotDone(_)
                | PackError::NotAPack { .. }
                | PackError::Format { .. }
                | PackError::Read { .. }
        )
    )
}

/// Whether an error is that a signal stopped the work.
pub fn is_cancelled(error: &anyhow::Error) -> bool {
    matches!(error.downcast_ref(), Some(PackError::Cancelled))
}
