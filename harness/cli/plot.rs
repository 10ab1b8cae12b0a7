//! `harness plot`.

use super::DONE;
use super::compare::metric;
use super::sheet::Style;
use super::table::shown;
use anyhow::{Result, bail};
use clap::Args;
use clap::builder::{PossibleValuesParser, TypedValueParser};
use harness::analysis::{Analysis, Mean, NETWORK, Selection, Setting};
use harness::figures::{Format, Key, Plot as Drawn};
use harness::registry::Registry;
use harness::spec::Task;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

#[derive(Args)]
pub struct Plot {
    /// Experiments to plot, as `harness ls` names them [default: all]
    #[arg(value_name = "EXPERIMENT")]
    experiments: Vec<String>,
    /// The key along the horizontal axis
    #[arg(long, value_name = "KEY", value_parser = key())]
    x: Key,
    /// The metric along the vertical axis
    #[arg(long, value_name = "METRIC", value_parser = metric)]
    y: String,
    /// The keys that distinguish series
    #[arg(long, value_name = "KEY", value_delimiter = ',', value_parser = key())]
    by: Vec<Key>,
    /// The key that distinguishes panels
    #[arg(long, value_name = "KEY", value_parser = key())]
    facet: Option<Key>,
    /// The network's task
    #[arg(long, default_value = "prediction", value_parser = PossibleValuesParser::new(Task::ALL.iter().map(|task| task.name())))]
    task: String,
    /// Only this predicted modality, such as contact_force
    #[arg(long, value_name = "NAME")]
    modality: Option<String>,
    /// Only runs with this setting, such as training.batch_size=64
    #[arg(long = "where", value_name = "KEY=VALUE")]
    settings: Vec<Setting>,
    /// The file to write: .svg, .png, or .csv with the numbers
    #[arg(long, short, value_name = "FILE", default_value = "plot.svg", value_parser = output)]
    output: (PathBuf, Format),
}

/// A parser for names of keys, whose error lists all names.
fn key() -> impl TypedValueParser<Value = Key> {
    PossibleValuesParser::new(Key::ALL.map(Key::name))
        .try_map(|name| Key::ALL.into_iter().find(|key| key.name() == name).ok_or("no such key"))
}

/// Parses the path of the output. Its ending names the format.
fn output(path: &str) -> Result<(PathBuf, Format), String> {
    let ending = Path::new(path).extension().and_then(|ending| ending.to_str()).unwrap_or_default();
    let format = Format::ALL.into_iter().find(|format| format.name() == ending);
    format
        .map(|format| (path.into(), format))
        .ok_or_else(|| "the file's name must end in .svg, .png or .csv".into())
}

impl Plot {
    /// Draws the plot to the file.
    pub fn execute(self, registry: &Registry) -> Result<ExitCode> {
        let selection = Selection {
            experiments: self.experiments.clone(),
            settings: self.settings.clone(),
            simulated: false,
        };
        let analysis = Analysis::new(registry, &selection)?;
        analysis.check_finished(&self.experiments)?;
        for note in analysis.notes() {
            eprintln!("{note}");
        }
        let all = analysis.means()?;
        let of_task = |mean: &&Mean| mean.of.model == NETWORK && mean.of.task.name() == self.task;
        let has = |mean: &Mean, modality: &String| mean.of.modality.name() == modality;
        let means: Vec<Mean> = all
            .iter()
            .filter(of_task)
            .filter(|mean| mean.of.metric == self.y)
            .filter(|mean| self.modality.as_ref().is_none_or(|modality| has(mean, modality)))
            .cloned()
            .collect();
        let Some(first) = means.first() else {
            let there: BTreeSet<String> = all
                .iter()
                .filter(of_task)
                .map(|mean| format!("{} of {}", mean.of.metric, mean.of.modality.name()))
                .collect();
            let there: Vec<String> = there.into_iter().collect();
            let there = if there.is_empty() { "none".into() } else { there.join(", ") };
            bail!("no finished run has this metric of this task and modality; there is: {there}");
        };
        let label = Style::Markdown.metric(&self.y, &first.unit);
        let modalities: BTreeSet<&str> = means.iter().map(|mean| mean.of.modality.name()).collect();
        let label = match modalities.len() {
            1 => format!("{}, {label}", first.of.modality.name().replace('_', " ")),
            _ => label,
        };
        let plot = Drawn { x: self.x, by: self.by, facet: self.facet, label };
        let (path, format) = self.output;
        plot.draw(&means)?.save_as(&path, format)?;
        println!("{} means in {}", means.len(), shown(&path));
        Ok(ExitCode::from(DONE))
    }
}
