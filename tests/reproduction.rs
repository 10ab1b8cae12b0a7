//! Compares every number in docs/reproduction.md with its query's answer on the published results.
//!
//! A number is between HTML comments: `<!--= value recommended vision_improves_force_r2 empty -->0.35<!---->`. The
//! reading `own` stands for the experiments that the claims name.
//! After other results were published, `UPDATE=1 cargo test --test all reproduction` updates the numbers.

use harness::analysis::Interval;
use harness::catalog::query;
use harness::claims::{self, Claim, Counts, Judgment, Matrix, MatrixRow, OWN, Readings, Verdict};
use harness::registry::Registry;
use harness::spec::{self, Experiment, Scenario};
use std::fmt::Write;
use std::path::{Path, PathBuf};

const BEGIN: &str = "<!--= ";
const END: &str = "<!---->";

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn page() -> PathBuf {
    root().join("docs/reproduction.md")
}

/// The results that the comments refer to.
struct Source<'a> {
    registry: &'a Registry,
    /// The judgments by the readings of paper.yaml and by the claims' own experiments.
    families: Matrix<'a>,
    /// The spec readings.yaml, and the judgments by its readings.
    spec: &'a Experiment,
    matrix: Matrix<'a>,
}

impl Source<'_> {
    /// The text for a comment.
    fn answer(&self, mark: &str) -> String {
        let words: Vec<&str> = mark.split_whitespace().collect();
        match words.as_slice() {
            ["value", family, id, scenario] => {
                self.judgment(family, id, scenario).interval().map_or("-".into(), short)
            }
            ["verdict", family, id, scenario] => self.judgment(family, id, scenario).verdict().to_string(),
            ["counts", family] => self.counts(family),
            ["corrected", family] => self.corrected(family),
            ["differ", family, other] => self.differ(family, other),
            ["open", family] => self.open(family),
            ["statements"] => self.statements(),
            ["choices"] => self.choices(),
            ["matrix"] => self.changes(),
            ["readings", id, scenario] => self.readings(id, scenario),
            ["query", sql @ ..] => {
                let answer = query(self.registry, &sql.join(" ")).unwrap();
                let value = answer.columns()[0].get(0).unwrap();
                value.extract::<f64>().map_or("-".into(), |value| format!("{value:.2}"))
            }
            _ => panic!("'{mark}' is no mark"),
        }
    }

    /// The position of a family among the judgments.
    fn place_of(&self, family: &str) -> usize {
        let name = if family == "own" { OWN } else { family };
        let place = self.families.readings.iter().position(|reading| *reading == name);
        place.unwrap_or_else(|| panic!("there are no runs of '{family}'"))
    }

    fn judgments(&self, family: &str) -> Vec<&Judgment<'_>> {
        self.families.column(self.place_of(family)).collect()
    }

    fn judgment(&self, family: &str, id: &str, scenario: &str) -> &Judgment<'_> {
        let is_it = |one: &&&Judgment| one.claim.id() == id && place(one.scenario) == scenario;
        let judgments = self.judgments(family);
        judgments.iter().find(is_it).unwrap_or_else(|| panic!("there is no claim '{id} {scenario}'"))
    }

    fn counts(&self, family: &str) -> String {
        let judgments = self.judgments(family);
        let Counts { holds, fails, undecided, untestable, missing, .. } = Counts::of(&judgments);
        let lacking = if missing > 0 { format!(", and {missing} have no runs yet") } else { String::new() };
        format!(
            "Of {} verdicts, {holds} say that a statement of the paper holds here, {fails} that it does not, and \
             {undecided} that these runs do not decide it; {untestable} are not testable{lacking}.",
            judgments.len()
        )
    }

    /// For each judgment of a family, whether its verdict stands after Holm's correction.
    fn stands(&self, place: usize) -> Vec<bool> {
        let corrected = claims::corrected(self.families.column(place));
        self.families.column(place).zip(corrected).map(|(one, corrected)| one.stands(corrected)).collect()
    }

    fn corrected(&self, family: &str) -> String {
        let Counts { holds, fails, unsure, tests, .. } = Counts::of(&self.judgments(family));
        format!(
            "Holm's correction for {tests} tests makes {unsure} of the {} verdicts \"holds\" and \"does not hold\" \
             undecided.",
            holds + fails
        )
    }

    /// A table of the claims that a family decides, and that another one leaves open or decides differently.
    fn differ(&self, family: &str, other: &str) -> String {
        let mut table = format!(
            "\n| claim | scenario | {} | {} |\n|---|---|---|---|\n",
            titled(self.families.readings[self.place_of(family)]),
            titled(self.families.readings[self.place_of(other)]),
        );
        for (new, old) in self.judgments(family).into_iter().zip(self.judgments(other)) {
            let is_new = matches!(new.verdict(), Verdict::Holds | Verdict::DoesNotHold);
            if is_new && new.verdict() != old.verdict() && old.verdict() != Verdict::NoData {
                let cells = [new, old].map(|one| one.verdict().to_string()).join(" | ");
                writeln!(table, "| `{}` | {} | {cells} |", new.claim.id(), place(new.scenario)).unwrap();
            }
        }
        table
    }

    /// A table of a family's claims that have runs and are not decided, with what keeps them from it.
    fn open(&self, family: &str) -> String {
        let mut table =
            "\n| claim | scenario | verdict | value and requirement |\n|---|---|---|---|\n".to_owned();
        for one in self.judgments(family) {
            let why = match one.verdict() {
                Verdict::NotTestable => one.unmet().unwrap_or_default(),
                Verdict::Undecided => {
                    let value = one.interval().map_or("-".into(), |interval| interval.to_string());
                    format!("{}: {value}, {}", one.claim.measured, one.claim.condition)
                }
                _ => continue,
            };
            let (id, scenario) = (one.claim.id(), place(one.scenario));
            writeln!(table, "| `{id}` | {scenario} | {} | {why} |", one.verdict()).unwrap();
        }
        table
    }

    /// A table with a row for each claim and scenario: the verdicts of all families, with their values.
    fn statements(&self) -> String {
        let families = &self.families;
        let names: Vec<&str> = families.readings.iter().map(|name| titled(name)).collect();
        let mut table = format!(
            "\n| statement | place | scenario | {} |\n|---|---|---|{}\n",
            names.join(" | "),
            "---|".repeat(names.len())
        );
        let stands: Vec<Vec<bool>> = (0..names.len()).map(|place| self.stands(place)).collect();
        for (at, row) in families.rows.iter().enumerate() {
            let Claim { statement, section, .. } = row.claim;
            let cell = |(place, one): (usize, &Judgment)| {
                let mark = if stands[place][at] { "" } else { " *" };
                let value = one.interval().map_or(String::new(), |value| format!(": {}", short(value)));
                format!("{}{mark}{value}", one.verdict())
            };
            let cells: Vec<String> = row.judgments.iter().enumerate().map(cell).collect();
            let (scenario, cells) = (place(row.scenario), cells.join(" | "));
            writeln!(table, "| {statement} | {section} | {scenario} | {cells} |").unwrap();
        }
        table
    }

    /// A table with a row for each choice.
    fn choices(&self) -> String {
        let mut table =
            "\n| reading | open choice | base | this reading | the paper |\n|---|---|---|---|---|\n"
                .to_owned();
        for one in &self.spec.readings {
            let name = one.name.replace('_', " ");
            writeln!(table, "| {name} | {} | {} | {} | {} |", one.choice, one.base, one.instead, one.paper)
                .unwrap();
        }
        table
    }

    /// The verdicts that a reading changes.
    fn changes(&self) -> String {
        if self.matrix.rows.is_empty() {
            return UNPUBLISHED.into();
        }
        let names: Vec<String> = self.matrix.readings.iter().map(|name| name.replace('_', " ")).collect();
        let mut table = format!(
            "\n| claim | scenario | {} |\n|---|---|{}\n",
            names.join(" | "),
            "---|".repeat(names.len())
        );
        for row in self.matrix.rows.iter().filter(|row| row.changes().next().is_some()) {
            let cells: Vec<String> = row.judgments.iter().map(|one| one.verdict().to_string()).collect();
            let (id, cells) = (row.claim.id(), cells.join(" | "));
            writeln!(table, "| `{id}` | {} | {cells} |", place(row.scenario)).unwrap();
        }
        table
    }

    /// The readings under which a claim holds, and the values.
    fn readings(&self, id: &str, scenario: &str) -> String {
        let is_it = |row: &&MatrixRow| row.claim.id() == id && place(row.scenario) == scenario;
        let Some(row) = self.matrix.rows.iter().find(is_it) else { return UNPUBLISHED.into() };
        let mut parts = Vec::new();
        for (verdict, words) in [
            (Verdict::Holds, "holds under"),
            (Verdict::DoesNotHold, "does not hold under"),
            (Verdict::Undecided, "is undecided under"),
            (Verdict::NotTestable, "is not testable under"),
        ] {
            let own =
                self.matrix.readings.iter().zip(&row.judgments).filter(|(_, one)| one.verdict() == verdict);
            let named = own.map(|(name, one)| {
                format!("{} ({})", name.replace('_', " "), one.interval().map_or("-".into(), short))
            });
            let named: Vec<String> = named.collect();
            if !named.is_empty() {
                parts.push(format!("{words} {}", named.join(", ")));
            }
        }
        parts.join("; it ")
    }
}

const UNPUBLISHED: &str = "(the runs of the readings are not published)";

/// What the page calls a family.
fn titled(family: &str) -> &str {
    match family {
        "base" => "the recipe",
        "recommended" => "the recommended network",
        OWN => "as first published",
        other => other,
    }
}

fn place(scenario: Option<Scenario>) -> &'static str {
    scenario.map_or("both", Scenario::name)
}

/// A mean and its interval, with two decimals.
fn short(value: Interval) -> String {
    match value.bounds {
        Some((low, high)) => format!("{:.2} [{low:.2}, {high:.2}]", value.mean),
        None => format!("{:.2}", value.mean),
    }
}

/// Splits a text into parts: a text outside of comments, and the comment that follows it with its content.
fn parts(text: &str) -> Vec<(&str, Option<(&str, &str)>)> {
    let mut parts = Vec::new();
    let mut rest = text;
    while let Some((before, after)) = rest.split_once(BEGIN) {
        let (mark, after) = after.split_once(" -->").expect("a mark ends");
        let (content, after) = after.split_once(END).expect("what a mark gives ends");
        parts.push((before, Some((mark, content))));
        rest = after;
    }
    parts.push((rest, None));
    parts
}

#[test]
fn every_number_in_the_reproduction_is_what_its_query_gives() {
    let text = std::fs::read_to_string(page()).unwrap();
    let registry = Registry::new(root().join("results/reference"));
    let claims = claims::load(&root().join("experiments/claims.yaml")).unwrap().claims;
    let chosen: Vec<&Claim> = claims.iter().collect();
    let runs = claims::runs(&registry, &chosen, &[], false).unwrap();
    let paper = spec::load(&root().join("experiments/paper.yaml"), &[], false).unwrap();
    let families = Readings::new(&registry, &paper, &chosen, &[]).unwrap();
    let families = families.judge_beside(&chosen, &runs, false).unwrap().unwrap();
    let spec = spec::load(&root().join("experiments/readings.yaml"), &[], false).unwrap();
    let matrix = Readings::new(&registry, &spec, &chosen, &[]).unwrap().judge(&chosen).unwrap();
    let source = Source { registry: &registry, families, spec: &spec, matrix };
    let filled: String = parts(&text)
        .into_iter()
        .map(|(before, mark)| match mark {
            Some((mark, _)) => format!("{before}{BEGIN}{mark} -->{}{END}", source.answer(mark)),
            None => before.to_owned(),
        })
        .collect();
    if std::env::var_os("UPDATE").is_some() {
        return std::fs::write(page(), &filled).unwrap();
    }
    for (now, (before, written)) in parts(&filled).iter().zip(parts(&text)) {
        assert_eq!(now.1, written, "after {before:?}; UPDATE=1 writes what the marks give");
    }
}

#[test]
fn no_measured_number_stands_outside_of_a_mark() {
    let text = std::fs::read_to_string(page()).unwrap();
    let mut marks = 0;
    for (before, mark) in parts(&text) {
        marks += usize::from(mark.is_some());
        for word in before.split_whitespace() {
            let is_measured = word.split_once('.').is_some_and(|(whole, digits)| {
                whole.ends_with(|c: char| c.is_ascii_digit())
                    && digits.starts_with(|c: char| c.is_ascii_digit())
            });
            assert!(!is_measured || word.contains("2404.04220"), "{word} in {before:?}");
        }
    }
    assert!(marks > 10, "{marks}");
}
