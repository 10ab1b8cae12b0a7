//! `harness claims`.

use super::DONE;
use super::asked::Where;
use super::format::{Destination, Form, print_page};
use super::sheet::Style;
use super::table::{Grid, LINE, fitted, print_command, print_grid, print_text, width};
use anyhow::Result;
use clap::Args;
use harness::analysis::{Analysis, Mixed, Setting};
use harness::claims::{
    self, Claim, Counts, Each, Judgment, Matrix, MatrixRow, OWN, Plan, Readings, Step, Values, Verdict,
    corrected,
};
use harness::numbers::{counted, duration, rounded};
use harness::registry::Registry;
use harness::spec::{Experiment, Origin, QUICK, Scenario};
use polars::prelude::DataFrame;
use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::process::ExitCode;

/// The name of the usual file of claims.
const CLAIMS: &str = "claims";

#[derive(Args)]
pub struct Claims {
    /// Names of claims to judge. Their queries and the value of every seed are also printed [default: all claims]
    #[arg(value_name = "CLAIM")]
    chosen: Vec<String>,
    /// The file of claims. `claims` stands for claims.yaml, experiments/claims.yaml or the built-in claims, whichever
    /// exists first
    #[arg(long, value_name = "FILE", default_value = CLAIMS)]
    file: PathBuf,
    /// Judge by the quick runs (`harness run … --quick`)
    #[arg(long)]
    quick: bool,
    #[command(flatten)]
    runs: Where,
    /// Print how many more datasets or seeds would decide the undecided claims, with the commands that run them
    #[arg(long, conflicts_with_all = ["format", "output"])]
    plan: bool,
    /// Print statements, values and requirements of many claims as well, and how often links are touched
    #[arg(long)]
    all: bool,
    #[command(flatten)]
    to: Destination,
}

impl Claims {
    /// Judges the claims, and prints or writes the verdicts.
    pub fn execute(self, registry: &Registry) -> Result<ExitCode> {
        let file = claims::load(&self.file)?;
        let chosen = claims::choose(&file.claims, &self.chosen)?;
        let form = self.to.form()?;
        let spec = file.spec_of_readings(registry, self.quick)?;
        registry.check_there()?;
        let recorded = registry.recorded();
        // A plan is about the claims' own experiments, and so are settings that name no other experiment.
        let is_of_spec = |setting: &&Setting| {
            spec.as_ref().is_some_and(|spec| setting.experiment.as_ref() == Some(&spec.name))
        };
        let (mut of_spec, mut own): (Vec<Setting>, Vec<Setting>) =
            self.runs.settings.iter().cloned().partition(|setting| is_of_spec(&setting));
        let mut experiments = chosen.iter().flat_map(|claim| claim.experiments(self.quick));
        let has_own = experiments.any(|name| registry.has_runs(&name));
        if spec.is_some() && !has_own {
            // Without runs of the claims' own experiments, all settings are about the readings.
            of_spec.append(&mut own);
        }
        let runs = claims::runs_of(registry, recorded.clone(), &chosen, &own, self.quick)?;
        let is_about_all = !self.plan && (own.is_empty() || !of_spec.is_empty());
        if let Some(spec) = spec.as_ref().filter(|_| is_about_all) {
            let readings = Readings::of(registry, recorded, spec, &chosen, &of_spec)?;
            if let Some(matrix) = readings.judge_beside(&chosen, &runs, self.quick)? {
                return self
                    .print_families(&Families { readings: &readings, spec, runs: &runs, matrix }, form);
            }
        }
        let mut judged = Vec::new();
        for claim in &chosen {
            judged.extend(claims::judge(&runs, claim, self.quick)?);
        }
        let judgments: Vec<&Judgment> = judged.iter().collect();
        // A folder with runs of the readings, and none of the claims' own experiments, lacks those of a reading.
        let of_readings = spec.as_ref().filter(|_| !has_own);
        if !matches!(form, Form::Page(Style::Text)) {
            for note in runs.notes() {
                eprintln!("{note}");
            }
            return write(claims::table(&judgments)?, form);
        }
        if self.plan {
            print_plan(&claims::plan(&runs, &judged, self.quick), &judged);
            print_missing(&runs, &judgments, of_readings, self.quick)?;
            return Ok(ExitCode::from(DONE));
        }
        if self.is_short(&chosen) {
            Self::print_short(&[("verdict", judgments.clone())], None);
            runs.notes().iter().for_each(|note| print_text(note));
            print_missing(&runs, &judgments, of_readings, self.quick)?;
            return Ok(ExitCode::from(DONE));
        }
        print(&judged);
        if !self.chosen.is_empty() {
            print_all_values(&judgments);
            print_queries(&chosen, self.quick);
        }
        print_counts(&judgments);
        runs.notes().iter().for_each(|note| print_text(note));
        print_contacts(&runs, &self.experiments(&chosen))?;
        print_missing(&runs, &judgments, of_readings, self.quick)?;
        Ok(ExitCode::from(DONE))
    }

    /// Whether only the verdicts are printed. Few claims are printed with their values.
    fn is_short(&self, claims: &[&Claim]) -> bool {
        /// The number of claims that fit on a page.
        const FEW: usize = 8;
        !self.all && self.chosen.is_empty() && claims.len() > FEW
    }

    /// Prints the counts, and a line with the verdicts on each claim. Each column has the judgments of a reading, of
    /// the same claims and scenarios as the others. `explanation` says what the columns are.
    fn print_short(columns: &[(&str, Vec<&Judgment>)], explanation: Option<&str>) {
        for (name, judgments) in columns {
            let name = if columns.len() > 1 { format!("{name}: ") } else { String::new() };
            let counts = Counts::of(judgments);
            print_text(&format!("{name}{counts}"));
            print_unsure(&counts);
            print_mixed(judgments);
        }
        println!();
        let claims = |(_, judgments): &(&str, Vec<&Judgment>)| {
            let p_values = corrected(judgments.iter().copied());
            let judged: Vec<(&Judgment, Option<f64>)> = judgments.iter().copied().zip(p_values).collect();
            let of_claims = judged.chunk_by(|(a, _), (b, _)| a.claim.id() == b.claim.id());
            of_claims
                .map(|of_claim| (of_claim[0].0.claim.id().to_owned(), in_words(of_claim)))
                .collect::<Vec<_>>()
        };
        let mut rows: Vec<Vec<String>> = Vec::new();
        for (place, column) in columns.iter().map(claims).enumerate() {
            for (row, (claim, words)) in column.into_iter().enumerate() {
                if place == 0 {
                    rows.push(vec![claim]);
                }
                rows[row].push(words);
            }
        }
        let header: Vec<String> = std::iter::once("claim")
            .chain(columns.iter().map(|(name, _)| *name))
            .map(str::to_owned)
            .collect();
        print_grid(Grid { right: vec![false; header.len()], header, rows, ..Grid::default() });
        println!();
        if let Some(columns) = explanation {
            print_text(columns);
        }
        let mut judged = columns.iter().flat_map(|(_, judgments)| judgments);
        if judged.any(|judgment| judgment.resolution().is_some()) {
            print_text(
                "(±h): half of the interval's width. An undecided claim whose value is farther than h from the bound of \
                 its condition would have been decided",
            );
        }
        print_text("--all prints the statements, values and requirements");
    }

    /// The experiments that claims name, as they are called in tables.
    fn experiments(&self, claims: &[&Claim]) -> Vec<String> {
        let all: BTreeSet<String> = claims.iter().flat_map(|claim| claim.experiments(self.quick)).collect();
        all.into_iter().collect()
    }

    fn print_families(&self, families: &Families, form: Form) -> Result<ExitCode> {
        let Families { readings, spec, runs, matrix } = families;
        if !matches!(form, Form::Page(Style::Text)) {
            return write_matrix(matrix, form);
        }
        let claims = matrix.claims();
        let is_short = self.is_short(&claims);
        if is_short {
            let columns: Vec<_> = matrix.columns().collect();
            let each = columns.iter().map(|(name, _)| format!("{name}: {}", claims::described(spec, name)));
            Self::print_short(&columns, Some(&each.collect::<Vec<_>>().join("; ")));
        } else {
            print_beside(spec, matrix);
        }
        if !self.chosen.is_empty() {
            for (name, judgments) in matrix.columns() {
                println!("\n{name}:");
                print_all_values(&judgments);
            }
            print_queries(&claims, self.quick);
        }
        if !is_short {
            print_contacts(readings.analysis(), std::slice::from_ref(&spec.name))?;
        }
        let own = matrix.columns().find(|(name, _)| *name == OWN).map(|(_, judgments)| judgments);
        let lacks_runs = |(name, judgments): (&str, Vec<&Judgment>)| {
            name != OWN && judgments.iter().any(|judgment| judgment.verdict() == Verdict::NoData)
        };
        if matrix.columns().any(lacks_runs) || own.is_none() && !matrix.left_out.is_empty() {
            print_commands(readings.analysis(), std::iter::once(&name_of(spec)), self.quick);
        }
        let Some(own) = own else { return Ok(ExitCode::from(DONE)) };
        if !is_short {
            print_contacts(runs, &self.experiments(&claims))?;
        }
        print_absent(runs, &own, self.quick)?;
        let left_out = matrix.left_out.iter().flat_map(|claim| &claim.experiments);
        print_commands(runs, lacking(&own).chain(left_out), self.quick);
        Ok(ExitCode::from(DONE))
    }
}

/// Claims judged by the readings of a spec, and by their own experiments.
struct Families<'a> {
    readings: &'a Readings<'a>,
    spec: &'a Experiment,
    runs: &'a Analysis,
    matrix: Matrix<'a>,
}

/// Prints or writes a table with a row for each verdict under each reading.
fn write_matrix(matrix: &Matrix, form: Form) -> Result<ExitCode> {
    for note in &matrix.notes {
        eprintln!("{note}");
    }
    write(matrix.table()?, form)
}

/// The columns of the verdicts on a page.
const ON_PAGES: [&str; 11] = [
    "reading",
    "claim",
    "measured",
    "scenario",
    "datasets",
    "mean",
    "low",
    "high",
    "condition",
    "p_holm",
    "verdict",
];

/// Prints or writes a table with a row for each verdict.
fn write(mut verdicts: DataFrame, form: Form) -> Result<ExitCode> {
    match form {
        Form::Data(data) => data.write(&mut verdicts, "verdict"),
        Form::Page(style) => {
            let names = verdicts.get_column_names().into_iter().map(|name| name.as_str());
            let on_page: Vec<&str> = names.filter(|name| ON_PAGES.contains(name)).collect();
            print_page(Grid::of_table(&verdicts.select(on_page)?, usize::MAX), style);
            Ok(ExitCode::from(DONE))
        }
    }
}

/// Prints the verdict on each claim under each reading side by side, with the values.
fn print_beside(spec: &Experiment, matrix: &Matrix) {
    let corrected: Vec<Vec<Option<f64>>> =
        (0..matrix.readings.len()).map(|place| corrected(matrix.column(place))).collect();
    // Two lines: the value with its number of datasets, and the verdict.
    let cell = |row: usize, place: usize| {
        let judgment = &matrix.rows[row].judgments[place];
        let value = judgment
            .interval()
            .map_or("-".into(), |interval| format!("{interval}, n = {}", judgment.measured.datasets()));
        format!("{value}\n{}", verdict(&(judgment, corrected[place][row])))
    };
    let places = || 0..matrix.readings.len();
    let mut claims: Vec<Vec<usize>> = Vec::new();
    for (row, MatrixRow { claim, .. }) in matrix.rows.iter().enumerate() {
        match claims.last_mut() {
            Some(rows) if matrix.rows[rows[0]].claim.id() == claim.id() => rows.push(row),
            _ => claims.push(vec![row]),
        }
    }
    let of_claim = |rows: &Vec<usize>| {
        let claim = matrix.rows[rows[0]].claim;
        let scenarios = rows.iter().map(|row| matrix.rows[*row].scenario.map_or("both", Scenario::name));
        let head = [
            format!("{}\n{}", statement(claim), claim.id()),
            scenarios.collect::<Vec<_>>().join("\n\n"),
            claim.condition.to_string(),
        ];
        let cells =
            places().map(|place| rows.iter().map(|row| cell(*row, place)).collect::<Vec<_>>().join("\n"));
        head.into_iter().chain(cells).collect()
    };
    let header = ["claim", "scenario", "condition"].into_iter().chain(matrix.readings.iter().copied());
    let header: Vec<String> = header.map(str::to_owned).collect();
    let table = Grid {
        rows: claims.iter().map(of_claim).collect(),
        right: vec![false; header.len()],
        whole: (0..header.len()).map(|column| column > 0).collect(),
        ruled: true,
        header,
    };
    match width() {
        Some(limit) if !table.fits(limit) => {
            for row in 0..matrix.rows.len() {
                println!(
                    "{}",
                    listed_beside(
                        matrix,
                        row,
                        &places().map(|place| cell(row, place)).collect::<Vec<_>>(),
                        limit
                    )
                );
            }
        }
        limit => println!("{}", table.text(limit.or(Some(LINE.max(60 + 42 * matrix.readings.len() as u16))))),
    }
    print_text("\nn: number of datasets");
    for (name, judgments) in matrix.columns() {
        print_text(&format!("{name}: {}", claims::described(spec, name)));
        print_counts(&judgments);
    }
    if !matrix.left_out.is_empty() {
        let claims = counted(matrix.left_out.len(), "claim");
        print_text(&format!("{claims} without data"));
    }
    matrix.notes.iter().for_each(|note| print_text(note));
}

/// A line for each reading of a claim in a scenario, below the claim's statement.
fn listed_beside(matrix: &Matrix, row: usize, cells: &[String], limit: u16) -> String {
    let MatrixRow { claim, scenario, .. } = &matrix.rows[row];
    let scenario = scenario.map_or("both", Scenario::name);
    let heading = fitted(&format!("{} {scenario}: {}", claim.id(), statement(claim)), Some(limit));
    let condition = fitted(&format!("  condition: {}", claim.condition), Some(limit));
    let lines = matrix
        .readings
        .iter()
        .zip(cells)
        .map(|(name, cell)| fitted(&format!("  {name}: {}", cell.replace('\n', ": ")), Some(limit)));
    [heading, condition].into_iter().chain(lines).collect::<Vec<_>>().join("\n") + "\n"
}

/// Prints the numbers of verdicts, those that a correction makes undecided, the requirements that are not met, and the
/// settings in which runs differ.
fn print_counts(judgments: &[&Judgment]) {
    let counts = Counts::of(judgments);
    print_text(&format!(
        "{counts}; intervals are 95 % over datasets or, with one dataset, over seeds or episodes"
    ));
    print_unsure(&counts);
    print_unmet(judgments);
    print_mixed(judgments);
}

/// Prints how many verdicts a correction makes undecided.
fn print_unsure(counts: &Counts) {
    if counts.unsure > 0 {
        let Counts { unsure, tests, .. } = counts;
        print_text(&format!(
            "* {unsure} of these verdicts are undecided after Holm's correction for {tests} tests"
        ));
    }
}

/// Prints the settings in which runs differ, and which runs to choose.
fn print_mixed(judgments: &[&Judgment]) {
    let mixed: BTreeSet<String> =
        judgments.iter().flat_map(|judgment| &judgment.mixed).map(Mixed::to_string).collect();
    mixed.iter().for_each(|text| print_text(text));
}

fn print_plan(plan: &Plan, judgments: &[Judgment]) {
    let named = |claims: &[(&Claim, Option<Scenario>)]| {
        let name = |(claim, scenario): &(&Claim, Option<Scenario>)| {
            format!("{} {}", claim.id(), scenario.map_or("both", Scenario::name))
        };
        claims.iter().map(name).collect::<Vec<_>>().join(", ")
    };
    for step in &plan.steps {
        let Step { more, there, count, seconds, .. } = step;
        let purpose = if *there == 1 { "give an interval to" } else { "decide" };
        print_text(&format!(
            "{}, {}, about {}, would {purpose} {}{}",
            more.counted(*count),
            counted(step.runs, "run"),
            duration(*seconds),
            named(&step.decides),
            if step.commands.is_empty() { "" } else { ":" }
        ));
        step.commands.iter().for_each(|command| print_command("  ", command));
    }
    let most = Plan::MOST;
    for (claims, why) in [
        (&plan.out_of_reach, format!("{most} datasets or seeds would not decide")),
        (&plan.by_episode, "a dataset of more episodes may decide".to_owned()),
    ] {
        if !claims.is_empty() {
            print_text(&format!("{why}: {}", named(claims)));
        }
    }
    print_mixed(&judgments.iter().collect::<Vec<_>>());
    if plan.steps.is_empty() && plan.out_of_reach.is_empty() && plan.by_episode.is_empty() {
        let is_measured =
            |judgment: &Judgment| !matches!(judgment.verdict(), Verdict::NoData | Verdict::Mixed);
        let has_data = judgments.iter().any(is_measured);
        println!(
            "{}",
            if has_data {
                "no measured claim is undecided"
            } else {
                "there are no runs of the claims' own experiments"
            }
        );
    } else {
        print_text(
            "assuming that means and standard deviations stay the same, and that runs take as long as before",
        );
    }
}

/// Prints the claims as a table or, if it is too wide for the terminal, as a list.
fn print(judgments: &[Judgment]) {
    let all: Vec<(&Judgment, Option<f64>)> = judgments.iter().zip(corrected(judgments)).collect();
    let claims: Vec<_> = all.chunk_by(|(a, _), (b, _)| a.claim.id() == b.claim.id()).collect();
    let rows = claims.iter().map(|judgments| {
        let claim = judgments[0].0.claim;
        // Each scenario has a line in the cell.
        let lines = |of: &dyn Fn(&Judgment) -> String| {
            judgments.iter().map(|(judgment, _)| of(judgment)).collect::<Vec<_>>().join("\n")
        };
        [
            format!("{}\n{}", statement(claim), claim.id()),
            claim.measured.clone(),
            lines(&|judgment| scenario(judgment).to_owned()),
            lines(&value),
            lines(&|judgment| judgment.measured.datasets().to_string()),
            claim.condition.to_string(),
            judgments.iter().map(verdict).collect::<Vec<_>>().join("\n"),
        ]
    });
    let header = ["claim", "measured", "scenario", "value", "datasets", "condition", "verdict"];
    // A scenario, its value and its verdict are on the same line, so these columns are not broken.
    let whole = vec![false, false, true, true, true, false, true];
    let table = Grid { ruled: true, whole, ..Grid::of_texts(header, rows.collect()) };
    match width() {
        Some(limit) if !table.fits(limit) => {
            let claims: Vec<String> = claims.iter().map(|judgments| listed(judgments, limit)).collect();
            println!("{}\n", claims.join("\n\n"));
        }
        limit => println!("{}\n", table.text(limit.or(Some(LINE)))),
    }
}

/// The statement of a claim, with its section in a paper if there is one.
fn statement(claim: &Claim) -> String {
    match claim.section.as_str() {
        "" => claim.statement.clone(),
        section => format!("{} ({section})", claim.statement),
    }
}

/// A claim with a line for each scenario.
fn listed(judgments: &[(&Judgment, Option<f64>)], limit: u16) -> String {
    let claim = judgments[0].0.claim;
    let heading = format!("{}: {}", claim.id(), statement(claim));
    let measured = format!("  measured: {}; condition: {}", claim.measured, claim.condition);
    let lines = judgments.iter().map(|one| {
        let value = one.0.interval().map_or(String::new(), |interval| {
            format!("{interval}, {}: ", counted(one.0.measured.datasets(), "dataset"))
        });
        let text = format!("  {}: {value}{}", scenario(one.0), verdict(one));
        fitted(&text, Some(limit))
    });
    let head = [fitted(&heading, Some(limit)), fitted(&measured, Some(limit))];
    head.into_iter().chain(lines).collect::<Vec<_>>().join("\n")
}

fn value(judgment: &Judgment) -> String {
    judgment.interval().map_or("-".into(), |interval| interval.to_string())
}

/// The verdict, with a mark if it does not stand after the correction for several tests, and with what would have been
/// decided if it is open.
fn verdict((judgment, corrected): &(&Judgment, Option<f64>)) -> String {
    let mark = if judgment.stands(*corrected) { "" } else { " *" };
    let resolution = judgment.resolution().map_or(String::new(), |half| format!(" (±{})", rounded(half)));
    format!("{}{mark}{resolution}", judgment.verdict())
}

fn scenario(judgment: &Judgment) -> &'static str {
    judgment.scenario.map_or("both", Scenario::name)
}

/// Prints the values that claims and their requirements are judged by.
fn print_all_values(judgments: &[&Judgment]) {
    for judgment in judgments {
        let (id, scenario) = (judgment.claim.id(), scenario(judgment));
        for (scenario, values) in judgment.groups() {
            let scenario = scenario.map_or("both", Scenario::name);
            print_values(&format!("{id} {scenario}"), judgment.measured.each, values);
        }
        if let Some(required) = &judgment.required {
            print_values(&format!("{id} {scenario} requires"), required.each, &required.values);
        }
    }
}

/// Prints the queries of claims.
fn print_queries(claims: &[&Claim], quick: bool) {
    for claim in claims {
        println!("\n{}:\n{}", claim.id(), claim.sql(quick));
        if let (Some(requirement), Some(sql)) = (&claim.requires, claim.required_sql(quick)) {
            print_text(&format!("requires {}, {}:", requirement.measured, requirement.condition));
            println!("{sql}");
        }
    }
}

fn print_values(of: &str, each: Each, values: &Values) {
    let name = each.name();
    let several =
        values.keys().any(|(dataset, _)| Some(dataset) != values.keys().next().map(|(first, _)| first));
    let place = |(dataset, n): &(u64, i64)| match each {
        Each::Dataset => format!("dataset {dataset}"),
        _ if several => format!("dataset {dataset} {name} {n}"),
        _ => format!("{name} {n}"),
    };
    let values: Vec<String> =
        values.iter().map(|(at, value)| format!("{}: {}", place(at), rounded(*value))).collect();
    if !values.is_empty() {
        print_text(&format!("{of}: {}", values.join(", ")));
    }
}

/// The verdicts on a claim: one if all scenarios have the same, otherwise that of each.
fn in_words(judgments: &[(&Judgment, Option<f64>)]) -> String {
    let verdicts: BTreeSet<String> = judgments.iter().map(verdict).collect();
    if verdicts.len() == 1 {
        return verdicts.into_iter().collect();
    }
    let word = |judged: &(&Judgment, Option<f64>)| format!("{}: {}", scenario(judged.0), verdict(judged));
    judgments.iter().map(word).collect::<Vec<_>>().join(", ")
}

/// Prints the scenarios and metrics of claims without data that no run has, with those that there are.
fn print_absent(runs: &Analysis, judgments: &[&Judgment], quick: bool) -> Result<()> {
    let mut absent: BTreeSet<String> = BTreeSet::new();
    for judgment in judgments.iter().filter(|judgment| judgment.verdict() == Verdict::NoData) {
        absent.extend(judgment.claim.absent_metric(runs, quick)?);
        for scenario in judgment.groups().into_iter().filter_map(|(scenario, _)| scenario) {
            let experiments = judgment.claim.experiments(quick);
            absent.extend(experiments.iter().filter_map(|name| elsewhere(runs, name, scenario)));
        }
    }
    absent.iter().for_each(|text| print_text(text));
    Ok(())
}

/// Says in which scenarios the runs of an experiment are, if none is in this one.
fn elsewhere(runs: &Analysis, experiment: &str, scenario: Scenario) -> Option<String> {
    let there: BTreeSet<&Origin> =
        runs.runs(experiment).iter().map(|run| &run.record.spec.scenario).collect();
    let names: Vec<&str> = there.iter().map(|origin| origin.name()).collect();
    let is_absent = !there.is_empty() && !there.contains(&Origin::from(scenario));
    is_absent
        .then(|| format!("no run of {experiment} is in {scenario}; its runs are in {}", names.join(", ")))
}

/// Prints the commands that make the runs of the claims without data: those of this spec with readings or, without it, of
/// the claims' own experiments.
fn print_missing(
    runs: &Analysis,
    judgments: &[&Judgment],
    readings: Option<&Experiment>,
    quick: bool,
) -> Result<()> {
    print_absent(runs, judgments, quick)?;
    match readings {
        Some(spec) if lacking(judgments).next().is_some() => {
            print_commands(runs, std::iter::once(&name_of(spec)), quick);
        }
        _ => print_commands(runs, lacking(judgments), quick),
    }
    Ok(())
}

/// The name by which a spec is found. The experiment of its quick runs has another one.
fn name_of(spec: &Experiment) -> String {
    spec.name.strip_suffix(QUICK).unwrap_or(&spec.name).to_owned()
}

/// The experiments of the claims without data.
fn lacking<'a>(judgments: &'a [&'a Judgment]) -> impl Iterator<Item = &'a String> {
    let lacking = judgments.iter().filter(|judgment| judgment.verdict() == Verdict::NoData);
    lacking.flat_map(|judgment| &judgment.claim.experiments)
}

/// Prints the commands that make the runs of these experiments, each once.
fn print_commands<'a>(runs: &Analysis, experiments: impl Iterator<Item = &'a String>, quick: bool) {
    let experiments: BTreeSet<&String> = experiments.collect();
    if runs.is_published() && !experiments.is_empty() {
        print_text("no run is added to published results; these commands make runs in the folder results");
    }
    for experiment in experiments {
        match runs.command(experiment, quick) {
            Some(command) => print_command("for claims without data   ", &command),
            None => print_text(&format!("for claims without data   there is no spec called {experiment}")),
        }
    }
}

/// Prints how often links are touched in the datasets of these experiments.
fn print_contacts(runs: &Analysis, experiments: &[String]) -> Result<()> {
    let experiments: Vec<&str> = experiments.iter().map(String::as_str).collect();
    for contacts in claims::contacts(runs, &experiments)? {
        print_text(&contacts.to_string());
    }
    Ok(())
}

/// Prints the requirements that do not hold or are undecided, each with its claims.
fn print_unmet(judgments: &[&Judgment]) {
    let mut claims: BTreeMap<(&str, String), Vec<&str>> = BTreeMap::new();
    for judgment in judgments.iter().filter(|judgment| judgment.verdict() == Verdict::NotTestable) {
        let key = (scenario(judgment), judgment.unmet().unwrap_or_default());
        claims.entry(key).or_default().push(judgment.claim.id());
    }
    for ((scenario, unmet), claims) in claims {
        print_text(&format!("not testable, {scenario}   {unmet}: {}", claims.join(", ")));
    }
}
