//! `harness experiments`: lists the built-in experiments, or prints the spec of one.

use super::DONE;
use super::table::print_texts;
use anyhow::Result;
use clap::Args;
use clap::builder::PossibleValuesParser;
use harness::spec::{BuiltIn, SPECS, parse_spec};
use std::process::ExitCode;

#[derive(Args)]
pub struct Experiments {
    /// Print the spec of this experiment [default: list the experiments]
    #[arg(value_name = "NAME", value_parser = PossibleValuesParser::new(SPECS.iter().map(|spec| spec.name)))]
    #[arg(hide_possible_values = true)]
    name: Option<String>,
}

impl Experiments {
    /// Prints the list, or the spec.
    pub fn execute(self) -> Result<ExitCode> {
        if let Some(name) = self.name {
            SPECS.iter().filter(|spec| spec.name == name).for_each(|spec| print!("{}", spec.text));
            return Ok(ExitCode::from(DONE));
        }
        let described = |spec: &BuiltIn| {
            let experiment = parse_spec(&spec.label(), spec.text, &[], false)?;
            Ok([spec.name.to_owned(), experiment.description])
        };
        let rows = SPECS.iter().map(described).collect::<Result<Vec<[String; 2]>>>()?;
        print_texts(["experiment", "question"], rows);
        Ok(ExitCode::from(DONE))
    }
}
