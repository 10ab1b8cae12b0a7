//! `harness plot`.

use super::DONE;
use super::asked::{Asked, key};
use super::table::shown;
use anyhow::Result;
use clap::Args;
use harness::analysis::Key;
use harness::figures::{Format, Plot as Drawn};
use harness::numbers::counted;
use harness::registry::Registry;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

#[derive(Args)]
pub struct Plot {
    #[command(flatten)]
    asked: Asked,
    /// The key along the horizontal axis: one of those of --by, or a setting, such as input or network.hidden
    #[arg(long, value_name = "KEY", value_parser = key())]
    x: Key,
    /// The key that distinguishes panels
    #[arg(long, value_name = "KEY", value_parser = key())]
    facet: Option<Key>,
    /// The file to write: .svg, .png, .pdf, or .csv with the numbers
    #[arg(long, short, value_name = "FILE", default_value = "plot.svg", value_parser = output)]
    output: (PathBuf, Format),
}

/// Parses the path of the output. Its ending names the format.
fn output(path: &str) -> Result<(PathBuf, Format), String> {
    Ok((path.into(), Format::of(Path::new(path))?))
}

impl Plot {
    /// Draws the plot to the file.
    pub fn execute(self, registry: &Registry) -> Result<ExitCode> {
        let Self { asked, x, facet, output: (path, format) } = self;
        let (drawing, notes) = Drawn::new(asked.question(), x, facet).ask(registry)?;
        notes.iter().for_each(|note| eprintln!("{note}"));
        let means = counted(drawing.data.height(), "mean");
        drawing.save_as(&path, format)?;
        println!("{means} in {}", shown(&path));
        Ok(ExitCode::from(DONE))
    }
}
