//! Compares every number in docs/reproduction.md with its query's answer on the published results.
//!
//! A number is between HTML comments: `<!--= value vision_improves_force_r2 empty -->0.14<!---->`.
//! After other results were published, `UPDATE=1 cargo test --test all reproduction` updates the numbers.

use harness::analysis::Interval;
use harness::catalog::query;
use harness::claims::{self, Claim, Judgment, Matrix, MatrixRow, Readings, Verdict};
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
    judgments: Vec<Judgment<'a>>,
    spec: &'a Experiment,
    matrix: Matrix<'a>,
}

impl Source<'_> {
    /// The text for a comment.
    fn answer(&self, mark: &str) -> String {
        let words: Vec<&str> = mark.split_whitespace().collect();
        match words.as_slice() {
            ["value", id, scenario] => self.judgment(id, scenario).interval().map_or("-".into(), short),
            ["verdict", id, scenario] => self.judgment(id, scenario).verdict().to_string(),
            ["counts"] => self.counts(),
            ["corrected"] => self.corrected(),
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

    fn judgment(&self, id: &str, scenario: &str) -> &Judgment<'_> {
        let is_it = |one: &&Judgment| one.claim.id() == id && place(one.scenario) == scenario;
        self.judgments.iter().find(is_it).unwrap_or_else(|| panic!("there is no claim '{id} {scenario}'"))
    }

    fn counts(&self) -> String {
        let count =
            |of: &dyn Fn(Verdict) -> bool| self.judgments.iter().filter(|one| of(one.verdict())).count();
        let (hold, fail) = (count(&|v| v == Verdict::Holds), count(&|v| v == Verdict::DoesNotHold));
        let untestable = count(&|verdict| verdict == Verdict::NotTestable);
        let all = self.judgments.len();
        format!(
            "Of {all} verdicts, {hold} say that a statement of the paper holds here, {fail} that it does not, and {} \
             that these runs do not decide it; {untestable} are not testable.",
            all - hold - fail - untestable
        )
    }

    /// For each judgment, whether its verdict stands after Holm's correction.
    fn stands(&self) -> Vec<bool> {
        let corrected = claims::corrected(&self.judgments);
        self.judgments.iter().zip(corrected).map(|(one, corrected)| one.stands(corrected)).collect()
    }

    fn corrected(&self) -> String {
        let tests = claims::corrected(&self.judgments).into_iter().flatten().count();
        let is_decided = |one: &&Judgment| matches!(one.verdict(), Verdict::Holds | Verdict::DoesNotHold);
        let decided = self.judgments.iter().filter(is_decided).count();
        let unsure = self.stands().into_iter().filter(|stands| !stands).count();
        format!(
            "Holm's correction for {tests} tests makes {unsure} of the {decided} verdicts \"holds\" and \"does not \
             hold\" undecided."
        )
    }

    /// A table with a row for each claim: what was measured, and the verdicts.
    fn statements(&self) -> String {
        let mut table =
            "\n| statement | place | empty | cluttered | both |\n|---|---|---|---|---|\n".to_owned();
        let judged: Vec<(&Judgment, bool)> = self.judgments.iter().zip(self.stands()).collect();
        for own in judged.chunk_by(|(a, _), (b, _)| a.claim.id() == b.claim.id()) {
            let Claim { statement, section, .. } = own[0].0.claim;
            let cell = |scenario: Option<Scenario>| {
                let found = own.iter().find(|(one, _)| one.scenario == scenario);
                let mark = |stands: bool| if stands { "" } else { " *" };
                found.map_or(String::new(), |(one, stands)| format!("{}{}", one.verdict(), mark(*stands)))
            };
            let [empty, cluttered] = Scenario::PAPER.map(|scenario| cell(Some(scenario)));
            writeln!(table, "| {statement} | {section} | {empty} | {cluttered} | {} |", cell(None)).unwrap();
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
    let judgments = chosen.iter().flat_map(|claim| claims::judge(&runs, claim, false).unwrap()).collect();
    let spec = spec::load(&root().join("experiments/readings.yaml"), &[], false).unwrap();
    let matrix = Readings::new(&registry, &spec, &chosen, &[]).unwrap().judge(&chosen).unwrap();
    let source = Source { registry: &registry, judgments, spec: &spec, matrix };
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
