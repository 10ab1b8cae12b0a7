//! `harness import`, which the Python package does: this program says how to install and call it.

use anyhow::Result;
use clap::Args;
use harness::registry::{Registry, quoted};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

#[derive(Args)]
pub struct Import {
    /// The YAML file that says what to import, and which columns are which modality
    #[arg(value_name = "MAPPING")]
    mapping: PathBuf,
}

/// The message with the command to call instead.
#[derive(Debug, thiserror::Error)]
#[error(
    "`harness import` is a command of the Python package; in a clone of the repository, \
     `.venv/bin/pip install '.[import]'` installs the package, and then `.venv/bin/harness {0}` imports"
)]
pub struct ImportError(String);

impl Import {
    /// Names the command of the Python package that does the same.
    pub fn execute(self, registry: &Registry) -> Result<ExitCode> {
        let mapping = self.mapping.to_string_lossy();
        let results = registry.root().to_string_lossy();
        // The Python command reads its options after its name.
        let mut words = vec!["import", &*mapping];
        if registry.root() != Path::new("results") {
            words.extend(["--results", &*results]);
        }
        Err(ImportError(quoted(words)).into())
    }
}
