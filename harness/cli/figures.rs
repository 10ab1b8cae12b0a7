//! `harness figures`.

use super::table::shown;
use super::{DONE, FAILED};
use anyhow::Result;
use clap::Args;
use clap::builder::PossibleValuesParser;
use clap::builder::TypedValueParser;
use harness::analysis::{Analysis, Selection, Setting};
use harness::experiment::describe;
use harness::figures::source::{Experiments, Source};
use harness::figures::{Figure, Format};
use harness::registry::Registry;
use std::path::PathBuf;
use std::process::ExitCode;

#[derive(Args)]
pub struct Figures {
    /// The figures to draw [default: all]
    #[arg(value_name = "NAME", value_parser = figure())]
    names: Vec<Figure>,
    /// The folder to write <NAME>.svg, .png and .csv to
    #[arg(long, value_name = "DIR", default_value = "figures")]
    out: PathBuf,
    /// Which of these files to write, as png or svg,csv [default: all]
    #[arg(long = "format", value_name = "FORMAT", value_delimiter = ',', value_parser = format())]
    formats: Vec<Format>,
    /// Draw the quick runs of the experiments (`harness run … --quick`)
    #[arg(long)]
    quick: bool,
    /// Draw this experiment instead of single_to_multi, such as single_to_multi_best
    #[arg(long, value_name = "EXPERIMENT")]
    single: Option<String>,
    /// Draw this experiment instead of multi_to_multi, such as multi_to_multi_best
    #[arg(long, value_name = "EXPERIMENT")]
    multi: Option<String>,
    /// Only runs with this setting, such as training.epochs=200
    #[arg(long = "where", value_name = "KEY=VALUE")]
    settings: Vec<Setting>,
}

/// A parser for names of figures, whose error lists all names.
fn figure() -> impl TypedValueParser<Value = Figure> {
    PossibleValuesParser::new(Figure::ALL.map(Figure::name))
        .try_map(|name| Figure::ALL.into_iter().find(|figure| figure.name() == name).ok_or("no such figure"))
}

fn format() -> impl TypedValueParser<Value = Format> {
    PossibleValuesParser::new(Format::ALL.map(Format::name))
        .try_map(|name| Format::ALL.into_iter().find(|format| format.name() == name).ok_or("no such format"))
}

impl Figures {
    /// Draws the figures. If none is named, figures whose runs are missing are skipped without a failure.
    pub fn execute(self, registry: &Registry) -> Result<ExitCode> {
        let paper = Experiments::of_the_paper(self.quick);
        let experiments = Experiments {
            single_to_multi: self.single.unwrap_or(paper.single_to_multi),
            multi_to_multi: self.multi.unwrap_or(paper.multi_to_multi),
            readings: paper.readings,
        };
        let names = experiments.names().into_iter().chain([experiments.readings.clone()]).collect();
        let selection = Selection { experiments: names, settings: self.settings, simulated: true };
        let analysis = Analysis::new(registry, &selection)?;
        for note in analysis.notes() {
            eprintln!("{note}");
        }
        let source = Source::new(&analysis, experiments);
        let named = !self.names.is_empty();
        let wanted = if named { self.names } else { Figure::ALL.to_vec() };
        let formats = if self.formats.is_empty() { Format::ALL.to_vec() } else { self.formats };
        let (mut drawn, mut failed) = (0, false);
        for figure in wanted {
            let saved =
                figure.render(&source).and_then(|drawing| drawing.save(&self.out, figure.name(), &formats));
            match saved {
                Ok(()) => {
                    drawn += 1;
                    let file = format!("{}.{}", figure.name(), formats[0].name());
                    println!("{:<27} {}", figure.name(), shown(&self.out.join(file)));
                }
                Err(error) => {
                    failed |= named || !error.is_missing_runs();
                    eprintln!("{:<27} not drawn: {}", figure.name(), describe(&error));
                }
            }
        }
        Ok(ExitCode::from(if failed || drawn == 0 { FAILED } else { DONE }))
    }
}
