//! `harness figures`.

use super::asked::Where;
use super::table::{print_beside, shown};
use super::{DONE, FAILED};
use anyhow::Result;
use clap::Args;
use clap::builder::PossibleValuesParser;
use clap::builder::TypedValueParser;
use harness::analysis::Analysis;
use harness::experiment::describe;
use harness::figures::{Drawing, Figure, FigureError, Format, OfReading, Shown};
use harness::registry::Registry;
use std::path::PathBuf;
use std::process::ExitCode;

#[derive(Args)]
pub struct Figures {
    /// The figures to draw [default: all]
    #[arg(value_name = "NAME", value_parser = figure())]
    names: Vec<Figure>,
    /// The folder for the files NAME.svg, NAME.png, NAME.pdf and NAME.csv
    #[arg(long, short, alias = "out", value_name = "DIR", default_value = "figures")]
    output: PathBuf,
    /// The kinds of files to write, separated by commas [default: all]
    #[arg(long = "format", value_name = "FORMAT", value_delimiter = ',', value_parser = format())]
    formats: Vec<Format>,
    /// Draw the quick runs (`harness run … --quick`)
    #[arg(long)]
    quick: bool,
    /// Draw what the figures show of this experiment, of any robot, instead of the paper's experiments
    #[arg(long, value_name = "EXPERIMENT", conflicts_with_all = ["single", "multi", "quick"])]
    experiment: Option<String>,
    /// Draw this experiment instead of single_to_multi, for example my_single
    #[arg(long, value_name = "EXPERIMENT")]
    single: Option<String>,
    /// Draw this experiment instead of multi_to_multi, for example my_multi
    #[arg(long, value_name = "EXPERIMENT")]
    multi: Option<String>,
    /// Draw the runs under this reading of an experiment instead of single_to_multi and multi_to_multi, for example
    /// reproduction/base [default: reproduction/recommended, where there are no runs of these]
    #[arg(long, value_name = "EXPERIMENT/READING", conflicts_with_all = ["single", "multi", "experiment"])]
    reading: Option<String>,
    /// The modality that `horizon` or `confusion` shows, or the part of it with one unit, for example "joints in rad"
    /// [default: contact_force, or the first modality where it is not predicted]
    #[arg(long, value_name = "NAME")]
    of: Option<String>,
    #[command(flatten)]
    runs: Where,
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
    /// Draws the figures. If none is named, figures without runs that they can show are skipped without a failure.
    pub fn execute(self, registry: &Registry) -> Result<ExitCode> {
        if let Some(experiment) = &self.experiment {
            let analysis =
                Analysis::finished(registry, std::slice::from_ref(experiment), &self.runs.settings)?;
            for note in analysis.notes() {
                eprintln!("{note}");
            }
            return self.draw(|figure| figure.render_of(&analysis, experiment, self.of.clone()));
        }
        let reading = self.reading.as_ref().map(|text| OfReading::load(text, self.quick)).transpose()?;
        let (single, multi) = (self.single.clone(), self.multi.clone());
        let shown = Shown { quick: self.quick, single, multi, reading }.or_reproduction(registry)?;
        let analysis = shown.analysis(registry, &self.runs.settings)?;
        for note in analysis.notes() {
            eprintln!("{note}");
        }
        let source = shown.source(&analysis).showing(self.of.clone());
        self.draw(|figure| figure.render(&source))
    }

    /// Draws and saves the wanted figures, and says for each of the others why it is not drawn.
    fn draw(&self, render: impl Fn(Figure) -> Result<Drawing, FigureError>) -> Result<ExitCode> {
        let named = !self.names.is_empty();
        let wanted = if named { self.names.clone() } else { Figure::ALL.to_vec() };
        let formats = if self.formats.is_empty() { Format::ALL.to_vec() } else { self.formats.clone() };
        let (mut drawn, mut failed) = (0, false);
        for figure in wanted {
            let saved =
                render(figure).and_then(|drawing| drawing.save(&self.output, figure.name(), &formats));
            match saved {
                Ok(()) => {
                    drawn += 1;
                    let file = format!("{}.{}", figure.name(), formats[0].name());
                    print_beside([(format!("{:<26}", figure.name()), shown(&self.output.join(file)))]);
                }
                // Few experiments have categories.
                Err(error) if !named && figure == Figure::Confusion && error.has_nothing_to_draw() => {}
                Err(error) => {
                    failed |= named || !error.has_nothing_to_draw();
                    eprintln!("{:<27} not drawn: {}", figure.name(), describe(&error));
                }
            }
        }
        Ok(ExitCode::from(if failed || drawn == 0 { FAILED } else { DONE }))
    }
}
