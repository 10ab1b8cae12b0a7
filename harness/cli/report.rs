//! `harness report`.

use super::DONE;
use super::asked::Where;
use super::progress::Bars;
use super::table::shown;
use anyhow::Result;
use clap::Args;
use harness::files::write_bytes;
use harness::registry::Registry;
use harness::report::Asked;
use harness::{claims, report};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

#[derive(Args)]
pub struct Report {
    /// Report only on these experiments, as `harness ls` names them [default: all results]
    #[arg(value_name = "EXPERIMENT")]
    experiments: Vec<String>,
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
        let claims = claims::load(&self.claims)?;
        registry.check_there()?;
        let asked = Asked { experiments: self.experiments, settings: self.runs.settings, quick: self.quick };
        let page = report::page(registry, &claims, &asked, &Bars::default())?;
        write_bytes(&self.output, page.as_bytes())?;
        println!("{}, {}", shown(&self.output), harness::numbers::bytes(page.len() as u64));
        Ok(ExitCode::from(DONE))
    }
}
