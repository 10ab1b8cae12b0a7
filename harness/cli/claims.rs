//! `harness claims`.

use super::DONE;
use super::table::{shown, wrapped};
use anyhow::Result;
use clap::Args;
use harness::analysis::{Analysis, Interval, Mixed, Setting};
use harness::claims::{self, Judgement, Measured, Requirement, Verdict};
use harness::numbers::rounded;
use harness::registry::{self, Registry};
use harness::spec::Scenario;
use polars::prelude::{Column, DataFrame};
use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::process::ExitCode;

#[derive(Args)]
pub struct Claims {
    /// Claims to judge, with their queries and the value of every seed [default: all, in a table]
    #[arg(value_name = "CLAIM")]
    chosen: Vec<String>,
    /// The file of claims
    #[arg(long, value_name = "FILE", default_value = "experiments/claims.yaml")]
    file: PathBuf,
    /// Judge by the experiments' quick runs
    #[arg(long)]
    quick: bool,
    /// Only runs with this setting, as training.epochs=200
    #[arg(long = "where", value_name = "KEY=VALUE")]
    settings: Vec<Setting>,
    /// Write the verdicts to a file instead: .parquet, .csv or .json
    #[arg(long, short, value_name = "FILE")]
    output: Option<PathBuf>,
}

impl Claims {
    pub fn execute(self, registry: &Registry) -> Result<ExitCode> {
        let all = claims::load(&self.file)?;
        let chosen = claims::choose(&all, &self.chosen)?;
        let runs = claims::runs(registry, &chosen, &self.settings, self.quick)?;
        let mut judgements = Vec::new();
        for claim in chosen {
            judgements.extend(claims::judge(&runs, claim, self.quick)?);
        }
        if let Some(path) = self.output {
            registry::save(&mut frame(&judgements)?, &path)?;
            println!("{} verdicts in {}", judgements.len(), shown(&path));
            return Ok(ExitCode::from(DONE));
        }
        print(&judgements);
        if !self.chosen.is_empty() {
            print_details(&judgements, self.quick);
        }
        print_summary(&runs, &judgements, self.quick);
        Ok(ExitCode::from(DONE))
    }
}

fn print(judgements: &[Judgement]) {
    let rows = judgements.chunk_by(|a, b| a.claim.id() == b.claim.id()).map(|judgements| {
        let claim = judgements[0].claim;
        // A line a scenario.
        let lines =
            |of: &dyn Fn(&Judgement) -> String| judgements.iter().map(of).collect::<Vec<_>>().join("\n");
        [
            format!("{} ({})\n{}", claim.paper, claim.section, claim.id()),
            claim.measured.clone(),
            lines(&|judgement| scenario(judgement).to_owned()),
            lines(&|judgement| judgement.interval().map_or("-".into(), |interval| interval.to_string())),
            claim.condition.to_string(),
            lines(&|judgement| judgement.verdict().to_string()),
        ]
    });
    println!(
        "{}",
        wrapped(["claim", "measured", "scenario", "value", "condition", "verdict"], rows.collect())
    );
}

fn scenario(judgement: &Judgement) -> &'static str {
    judgement.scenario.map_or("both", Scenario::name)
}

fn print_details(judgements: &[Judgement], quick: bool) {
    for judgement in judgements {
        let (id, scenario) = (judgement.claim.id(), scenario(judgement));
        print_values(&format!("{id} {scenario}"), &judgement.measured);
        if let Some(required) = &judgement.required {
            print_values(&format!("{id} {scenario} requires"), required);
        }
    }
    for judgements in judgements.chunk_by(|a, b| a.claim.id() == b.claim.id()) {
        let claim = judgements[0].claim;
        println!("\n{}:\n{}", claim.id(), claim.sql(quick));
        if let (Some(requirement), Some(sql)) = (&claim.requires, claim.required_sql(quick)) {
            println!("requires {}, {}:\n{sql}", requirement.measured, requirement.condition);
        }
    }
}

fn print_values(of: &str, measured: &Measured) {
    let each = measured.each.name();
    let values: Vec<String> =
        measured.values.iter().map(|(n, value)| format!("{each} {n}: {}", rounded(*value))).collect();
    if !values.is_empty() {
        println!("{of}: {}", values.join(", "));
    }
}

fn print_summary(runs: &Analysis, judgements: &[Judgement], quick: bool) {
    let count = |verdict: fn(&Verdict) -> bool| judgements.iter().filter(|j| verdict(&j.verdict())).count();
    let (holds, fails) = (count(|v| *v == Verdict::Holds), count(|v| *v == Verdict::DoesNotHold));
    let untestable = count(|verdict| *verdict == Verdict::NotTestable);
    println!(
        "{holds} hold, {fails} do not hold, {} undecided, {untestable} not testable; intervals are 95 % over seeds \
         (forces: episodes)",
        judgements.len() - holds - fails - untestable,
    );
    print_unmet(judgements);
    let mixed: BTreeSet<String> =
        judgements.iter().flat_map(|judgement| &judgement.mixed).map(Mixed::to_string).collect();
    for text in runs.notes().iter().chain(&mixed) {
        println!("{text}");
    }
    let lacking = judgements.iter().filter(|judgement| judgement.verdict() == Verdict::NoData);
    let mut experiments: Vec<&String> = lacking.flat_map(|judgement| &judgement.claim.experiments).collect();
    experiments.sort_unstable();
    experiments.dedup();
    for experiment in experiments {
        println!("for those without data   {}", runs.command(experiment, quick));
    }
}

/// What claims require that is not met, with the claims.
fn print_unmet(judgements: &[Judgement]) {
    let mut claims: BTreeMap<(&str, String), Vec<&str>> = BTreeMap::new();
    for judgement in judgements.iter().filter(|judgement| judgement.verdict() == Verdict::NotTestable) {
        let key = (scenario(judgement), judgement.unmet().unwrap_or_default());
        claims.entry(key).or_default().push(judgement.claim.id());
    }
    for ((scenario, unmet), claims) in claims {
        println!("not testable, {scenario}   {unmet}: {}", claims.join(", "));
    }
}

/// The verdicts as a table for other programs.
fn frame(judgements: &[Judgement]) -> Result<DataFrame> {
    let text = |name: &str, of: &dyn Fn(&Judgement) -> Option<String>| {
        Column::new(name.into(), judgements.iter().map(of).collect::<Vec<_>>())
    };
    let numbers = |name: &str, of: &dyn Fn(&Judgement) -> Option<Interval>| {
        let intervals: Vec<Option<Interval>> = judgements.iter().map(of).collect();
        let column = |end: &str, of: fn(Interval) -> Option<f64>| {
            let values: Vec<Option<f64>> = intervals.iter().map(|interval| interval.and_then(of)).collect();
            Column::new(format!("{name}{end}").into(), values)
        };
        [
            column("mean", |interval| Some(interval.mean)),
            column("low", |interval| interval.bounds.map(|(low, _)| low)),
            column("high", |interval| interval.bounds.map(|(_, high)| high)),
        ]
    };
    let requirement = |name: &str, of: &dyn Fn(&Requirement) -> String| {
        text(name, &|judgement| judgement.claim.requires.as_ref().map(of))
    };
    let counts = judgements.iter().map(|judgement| judgement.measured.values.len() as i64);
    let mut columns = vec![
        text("claim", &|judgement| Some(judgement.claim.id().to_owned())),
        text("paper", &|judgement| Some(judgement.claim.paper.clone())),
        text("section", &|judgement| Some(judgement.claim.section.clone())),
        text("measured", &|judgement| Some(judgement.claim.measured.clone())),
        text("scenario", &|judgement| judgement.scenario.map(|scenario| scenario.name().to_owned())),
        text("each", &|judgement| Some(judgement.measured.each.name().to_owned())),
        Column::new("values".into(), counts.collect::<Vec<_>>()),
    ];
    columns.extend(numbers("", &|judgement| judgement.interval()));
    columns.push(text("condition", &|judgement| Some(judgement.claim.condition.to_string())));
    columns.push(requirement("requires", &|requirement| requirement.measured.clone()));
    columns.extend(numbers("required_", &|judgement| judgement.required.as_ref()?.interval()));
    columns.push(requirement("required_condition", &|requirement| requirement.condition.to_string()));
    columns.push(text("verdict", &|judgement| Some(judgement.verdict().to_string())));
    Ok(DataFrame::new(judgements.len(), columns)?)
}
