//! The files of a run's trained networks, and the networks as ONNX models.

use crate::model::{ModelError, finished, there};
use harness_learning::network::architecture;
use harness_learning::network::description::Description;
use harness_learning::onnx::{self, Described};
use harness_learning::{LearningError, checkpoint};
use harness_registry::{Registry, RunFolder, RunRecord};
use harness_spec::{Task, Trained};
use std::path::PathBuf;

/// Returns the task and the path of each network file of the finished run whose id, or `experiment/id`, begins with
/// `wanted`.
///
/// # Errors
/// When no run or several runs match, the run isn't done, or a network is missing or damaged.
pub fn network_files(registry: &Registry, wanted: &str) -> Result<Vec<(Task, PathBuf)>, ModelError> {
    let (folder, record, _) = finished(registry, wanted)?;
    let file = |task: &Task| {
        let path = folder.checkpoint(*task);
        checkpoint::open(there(&path)?)?;
        Ok((*task, path))
    };
    record.spec.tasks.iter().map(file).collect()
}

/// Whether a run whose id, or `experiment/id`, begins with `wanted` may have a network. Published copies have one only
/// if it was published with them.
pub fn may_have_network(registry: &Registry, wanted: &str) -> bool {
    let may_have = |record: &RunRecord| !record.published || record.has_network();
    registry.matching(wanted).is_ok_and(|found| found.iter().any(|(_, record)| may_have(record)))
}

/// Returns the path of the file that was attached to the finished run of an external model whose id, or
/// `experiment/id`, begins with `wanted`. `None` if the harness trained the run's network.
///
/// # Errors
/// When no run or several runs match, none was attached, or the file is damaged.
pub fn attached(registry: &Registry, wanted: &str) -> Result<Option<PathBuf>, ModelError> {
    let (folder, record) = registry.find(wanted)?;
    if record.spec.trained().is_none() && record.published {
        return Err(ModelError::NoNetwork(folder.path().to_owned()));
    }
    match (record.spec.trained(), record.attached(folder.path())?) {
        (Some(_), _) => Ok(None),
        (None, None) => Err(ModelError::NotLoaded(format!(
            "the predictions of {} come from another program, and no file of its model was attached to them",
            record.run
        ))),
        (None, attached) => Ok(attached),
    }
}

/// Returns the bytes of an ONNX model of the finished run whose id, or `experiment/id`, begins with `wanted`. It
/// predicts the next observation, or reconstructs the present one, as `task` says.
pub fn onnx(registry: &Registry, wanted: &str, task: Task) -> Result<Vec<u8>, ModelError> {
    let (folder, record, trained) = finished(registry, wanted)?;
    if !record.spec.tasks.contains(&task) {
        return Err(ModelError::NoReconstruction { run: record.run, tasks: record.spec.tasks });
    }
    let prediction = described(&folder, &record, &trained, Task::Prediction)?;
    let decoding = described(&folder, &record, &trained, task)?;
    let properties = [
        ("run", record.run.as_str()),
        ("experiment", &record.experiment),
        ("dataset", &record.dataset),
        ("scenario", record.spec.scenario.name()),
    ];
    Ok(onnx::model(&prediction, &decoding, &properties)?)
}

fn described(
    folder: &RunFolder,
    record: &RunRecord,
    trained: &Trained,
    task: Task,
) -> Result<Described, ModelError> {
    let path = folder.checkpoint(task);
    let (file, normalizers) = checkpoint::open(there(&path)?)?;
    let network = architecture(&record.spec, trained, &record.layout, task);
    let losses = &trained.training.losses;
    let description =
        Description::new(&network, task, record.spec.action, losses, &normalizers, &record.spec.window);
    Ok(Described { description: description.map_err(LearningError::from)?, file })
}
