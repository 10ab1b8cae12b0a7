//! `harness import`, which the Python package does: this program says how to install and call it.

use super::usage;
use anyhow::Result;
use clap::Args;
use harness::registry::{Registry, quoted};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

#[derive(Args)]
pub struct Import {
    /// The YAML file that says what to import, and which columns are which modality
    #[arg(value_name = "MAPPING", required_unless_present = "inspect")]
    mapping: Option<PathBuf>,
    /// List what is in a recording, and write a first mapping
    #[arg(long, value_name = "FILE", conflicts_with = "mapping")]
    inspect: Option<PathBuf>,
    /// The file for the first mapping [default: FILE.yaml]
    #[arg(long, value_name = "MAPPING", requires = "inspect")]
    output: Option<PathBuf>,
}

impl Import {
    /// Names the command of the Python package that does the same.
    pub fn execute(self, registry: &Registry) -> Result<ExitCode> {
        let is_import = self.mapping.is_some();
        let results =
            (is_import && registry.root() != Path::new("results")).then(|| registry.root().to_owned());
        // The Python command reads its options after its name.
        let mut words = vec!["import".to_owned()];
        words.extend(self.mapping.map(|path| path.to_string_lossy().into_owned()));
        for (option, path) in [("--inspect", self.inspect), ("--output", self.output), ("--results", results)]
        {
            let Some(path) = path else { continue };
            words.extend([option.to_owned(), path.to_string_lossy().into_owned()]);
        }
        let command = quoted(words.iter().map(String::as_str));
        Err(usage(format!(
            "`harness import` is a command of the Python package; in a clone of the repository, `.venv/bin/pip install \
             '.[import]'` installs the package, and then `.venv/bin/harness {command}` imports"
        )))
    }
}
