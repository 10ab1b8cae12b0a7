//! `harness export`.

use super::DONE;
use anyhow::Result;
use clap::Args;
use harness::experiment;
use harness::files;
use harness::registry::Registry;
use harness::spec::Task;
use std::path::PathBuf;
use std::process::ExitCode;

#[derive(Args)]
pub struct Export {
    /// The file's format: onnx. The command of the Python package has more formats
    #[arg(long, value_parser = format)]
    format: Format,
    /// The run's id, EXPERIMENT/ID or folder. A beginning is enough if only one run begins with it
    #[arg(value_name = "RUN")]
    run: String,
    /// The file to write
    #[arg(value_name = "OUTPUT")]
    output: PathBuf,
    /// The network to write: prediction of the next observation, or reconstruction of the present one
    #[arg(long, value_parser = task, default_value = "prediction")]
    task: Task,
}

/// A format that this program writes.
#[derive(Clone, Copy)]
enum Format {
    Onnx,
}

fn format(name: &str) -> Result<Format, String> {
    match name {
        "onnx" => Ok(Format::Onnx),
        other => Err(format!(
            "this program exports networks as onnx; the Python package (pip install .) also exports datasets, and \
             {other} may be one of its formats"
        )),
    }
}

fn task(name: &str) -> Result<Task, String> {
    let found = Task::ALL.iter().find(|task| task.name() == name);
    found.copied().ok_or_else(|| "allowed: prediction, reconstruction".into())
}

impl Export {
    /// Writes the file, and prints its path.
    pub fn execute(self, registry: &Registry) -> Result<ExitCode> {
        let Format::Onnx = self.format;
        let bytes = experiment::onnx(registry, &self.run, self.task)?;
        files::write_whole(&self.output, |path| std::fs::write(path, &bytes))?;
        println!("{}", self.output.display());
        Ok(ExitCode::from(DONE))
    }
}
