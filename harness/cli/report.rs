//! `harness report`.

use super::DONE;
use super::asked::Where;
use super::progress::Bars;
use super::table::shown;
use anyhow::Result;
use clap::Args;
use harness::dataset::AnyDataset;
use harness::experiment::dataset_notes;
use harness::files::write_bytes;
use harness::registry::Registry;
use harness::report::Asked;
use harness::samples::FramePlace;
use harness::{claims, report};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

#[derive(Args)]
pub struct Report {
    /// Report only on these experiments, as `harness ls` names them [default: all results]
    #[arg(value_name = "EXPERIMENT")]
    experiments: Vec<String>,
    /// Show what this dataset contains instead, before any training: its folder's name in `datasets`, or the beginning
    #[arg(long, value_name = "NAME", conflicts_with_all = ["experiments", "claims", "quick", "settings"])]
    dataset: Option<String>,
    /// The HTML file to write
    #[arg(long, short, alias = "out", value_name = "FILE", default_value = "report.html", value_parser = page)]
    output: PathBuf,
    /// The file of claims
    #[arg(long, value_name = "FILE", default_value = "claims")]
    claims: PathBuf,
    /// Report on the experiments' quick runs
    #[arg(long)]
    quick: bool,
    #[command(flatten)]
    runs: Where,
}

/// Parses the path of the output. Its ending names the only format.
fn page(path: &str) -> Result<PathBuf, String> {
    let path = Path::new(path);
    match path.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("html")) {
        true => Ok(path.to_owned()),
        false => Err("its name must end in .html".into()),
    }
}

impl Report {
    /// Writes the report.
    pub fn execute(self, registry: &Registry) -> Result<ExitCode> {
        let progress = Bars::default();
        let page = match &self.dataset {
            Some(name) => {
                let dataset = AnyDataset::named(&registry.datasets(), name)?;
                let samples = dataset.load(FramePlace::Nowhere, &progress)?;
                report::dataset_page(&dataset, &samples, dataset_notes(&dataset, &samples)?)?
            }
            None => {
                let claims = claims::load(&self.claims)?;
                registry.check_there()?;
                let (experiments, settings) = (self.experiments, self.runs.settings);
                let asked = Asked { experiments, settings, quick: self.quick };
                report::page(registry, &claims, &asked, &progress)?
            }
        };
        write_bytes(&self.output, page.as_bytes())?;
        println!("{}, {}", shown(&self.output), harness::numbers::bytes(page.len() as u64));
        Ok(ExitCode::from(DONE))
    }
}
