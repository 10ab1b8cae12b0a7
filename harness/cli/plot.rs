//! `harness plot`.

use super::table::shown;
use super::{DIVIDED, DONE, item, samples};
use anyhow::Result;
use clap::builder::{PossibleValue, PossibleValuesParser, StyledStr, TypedValueParser};
use clap::error::{ContextKind, ContextValue};
use clap::{Arg, Args, Command};
use harness::analysis::{Analysis, Key, Setting};
use harness::figures::{Format, Plot as Drawn};
use harness::judge::models::NETWORK;
use harness::numbers::counted;
use harness::registry::Registry;
use harness::spec::Task;
use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

#[derive(Args)]
pub struct Plot {
    /// Experiments to plot, as `harness ls` names them [default: all]
    #[arg(value_name = "EXPERIMENT")]
    experiments: Vec<String>,
    /// The key along the horizontal axis: one of those below, or a setting, such as input or network.hidden
    #[arg(long, value_name = "KEY", value_parser = key(&Key::ALL))]
    x: Key,
    /// The metric along the vertical axis: one of the harness, or one of your own
    #[arg(long, value_name = "METRIC")]
    y: String,
    /// The keys that distinguish series
    #[arg(long, value_name = "KEY", value_delimiter = ',', value_parser = key(&Key::ALL))]
    by: Vec<Key>,
    /// The key that distinguishes panels
    #[arg(long, value_name = "KEY", value_parser = key(&Key::ALL))]
    facet: Option<Key>,
    /// The models to plot, separated by commas: network, which stands for all networks and models of other programs,
    /// the baselines persistence, ridge and training_mean, or the name of a model of another program
    #[arg(long, value_name = "MODEL", value_delimiter = ',', value_parser = item, default_value = NETWORK)]
    models: Vec<String>,
    /// Plot only this task [default: prediction; both tasks if the plot distinguishes them]
    #[arg(long, value_parser = task())]
    task: Option<Task>,
    /// Plot predictions N samples ahead [default: the next sample; all horizons if the plot distinguishes them]
    #[arg(long, value_name = "N", value_parser = one_horizon)]
    horizon: Option<u32>,
    /// Plot only this predicted modality, for example contact_force, or the part of it with one unit, for example
    /// "joints in rad"
    #[arg(long, value_name = "NAME", value_parser = one_modality)]
    modality: Option<String>,
    /// Use only runs with this setting, for example training.batch_size=64; may be given several times. Several values of
    /// one setting are alternatives
    #[arg(long = "where", value_name = "KEY=VALUE")]
    settings: Vec<Setting>,
    /// The file to write: .svg, .png, or .csv with the numbers
    #[arg(long, short, value_name = "FILE", default_value = "plot.svg", value_parser = output)]
    output: (PathBuf, Format),
}

/// A parser for names of these keys, whose error lists them, and for the keys of settings.
pub fn key(allowed: &'static [Key]) -> impl TypedValueParser<Value = Key> {
    KeyParser(allowed)
}

#[derive(Clone)]
struct KeyParser(&'static [Key]);

impl KeyParser {
    fn named(&self) -> impl Iterator<Item = PossibleValue> + use<> {
        self.0.iter().map(|key| PossibleValue::new(key.name()).help(key.meaning()))
    }
}

impl TypedValueParser for KeyParser {
    type Value = Key;

    fn parse_ref(&self, command: &Command, arg: Option<&Arg>, value: &OsStr) -> Result<Key, clap::Error> {
        let key = value.to_str().and_then(|text| text.parse::<Key>().ok());
        let named = PossibleValuesParser::new(self.named()).try_map(|name| name.parse());
        if let Some(key) = key.filter(|key| key.setting().is_some()) {
            return Ok(key);
        }
        named.parse_ref(command, arg, value).map_err(|mut error| {
            let of_settings = "settings of a spec are possible too, such as input or network.hidden";
            let hint = StyledStr::from(if value.is_empty() { DIVIDED } else { of_settings });
            error.insert(ContextKind::Suggested, ContextValue::StyledStrs(vec![hint]));
            error
        })
    }

    fn possible_values(&self) -> Option<Box<dyn Iterator<Item = PossibleValue> + '_>> {
        Some(Box::new(self.named()))
    }
}

/// Parses the horizon of a plot.
fn one_horizon(text: &str) -> Result<u32, String> {
    if text.contains(',') {
        return Err("a plot has one horizon; --by horizon distinguishes all of them".into());
    }
    samples(text)
}

/// Parses the name of a plot's modality.
fn one_modality(text: &str) -> Result<String, String> {
    if text.contains(',') {
        return Err("a plot has one modality; --by modality distinguishes all of them".into());
    }
    Ok(text.to_owned())
}

/// A parser for names of tasks, whose error lists all names.
fn task() -> impl TypedValueParser<Value = Task> {
    PossibleValuesParser::new(Task::ALL.iter().map(|task| task.name()))
        .try_map(|name| Task::ALL.iter().copied().find(|task| task.name() == name).ok_or("no such task"))
}

/// Parses the path of the output. Its ending names the format.
fn output(path: &str) -> Result<(PathBuf, Format), String> {
    Ok((path.into(), Format::of(Path::new(path))?))
}

impl Plot {
    /// Draws the plot to the file.
    pub fn execute(self, registry: &Registry) -> Result<ExitCode> {
        let analysis = Analysis::finished(registry, &self.experiments, &self.settings)?;
        for note in analysis.notes() {
            eprintln!("{note}");
        }
        let Self { x, y, by, facet, models, task, horizon, modality, output: (path, format), .. } = self;
        let horizon = horizon.map(|horizon| horizon as usize);
        let drawing = Drawn { x, y, by, facet, task, horizon, modality, models }.draw(&analysis)?;
        let means = counted(drawing.data.height(), "mean");
        drawing.save_as(&path, format)?;
        println!("{means} in {}", shown(&path));
        Ok(ExitCode::from(DONE))
    }
}
