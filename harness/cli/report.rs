//! `harness report`.

use super::DONE;
use super::progress::Bars;
use super::table::shown;
use anyhow::Result;
use clap::Args;
use harness::analysis::Setting;
use harness::files::write_bytes;
use harness::registry::Registry;
use harness::{claims, report, spec};
use std::path::PathBuf;
use std::process::ExitCode;

#[derive(Args)]
pub struct Report {
    /// The HTML file to write
    #[arg(long, value_name = "FILE", default_value = "report.html")]
    out: PathBuf,
    /// The file of claims
    #[arg(long, value_name = "FILE", default_value = "claims")]
    claims: PathBuf,
    /// The spec with the readings under which claims are judged too
    #[arg(long, value_name = "FILE", default_value = "readings")]
    readings: PathBuf,
    /// Report on the experiments' quick runs
    #[arg(long)]
    quick: bool,
    /// Only runs with this setting, such as training.epochs=200
    #[arg(long = "where", value_name = "KEY=VALUE")]
    settings: Vec<Setting>,
}

impl Report {
    /// Writes the report.
    pub fn execute(self, registry: &Registry) -> Result<ExitCode> {
        let claims = claims::load(&self.claims)?;
        let readings = spec::load(&self.readings, &[], self.quick)?;
        let page = report::page(registry, &claims, &readings, &self.settings, self.quick, &Bars::default())?;
        write_bytes(&self.out, page.as_bytes())?;
        println!("{}, {}", shown(&self.out), harness::numbers::bytes(page.len() as u64));
        Ok(ExitCode::from(DONE))
    }
}
