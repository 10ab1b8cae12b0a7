//! Judges the claims and puts the verdicts into words.

use super::ReportError;
use harness_analysis::{Analysis, Mixed};
use harness_claims::{
    Claim, Condition, Contacts, Counts, Each, Judgment, Matrix, MatrixRow, Readings, Verdict, contacts,
    corrected, described, judge,
};
use harness_registry::Registry;
use harness_shared::numbers::{counted, rounded};
use harness_spec::{Experiment, Scenario};
use serde::Serialize;
use std::collections::BTreeSet;

/// All claims with their verdicts.
#[derive(Serialize)]
pub struct Verdicts {
    claims: Vec<Judged>,
    counts: Counts,
    /// How often links are touched in the datasets that the claims are judged on.
    contacts: Vec<String>,
    /// The readings that the claims are also judged by.
    readings: Vec<OfReading>,
    /// Whether there are only runs of readings.
    is_of_readings: bool,
    /// The commands that make the runs of claims without data.
    #[serde(skip)]
    pub commands: BTreeSet<String>,
    /// Messages about runs that can't be combined because their settings differ.
    #[serde(skip)]
    pub mixed: BTreeSet<String>,
}

/// The verdicts under a reading on the claims that it has runs for, counted.
#[derive(Serialize)]
struct OfReading {
    name: String,
    described: String,
    /// The number of verdicts.
    judged: usize,
    counts: Counts,
}

/// The judgment under a reading, beside that by the claim's own experiments.
#[derive(Serialize)]
struct Beside {
    reading: String,
    #[serde(flatten)]
    words: Words,
}

/// A claim and its judgments in words. There is one judgment per scenario, or one over both scenarios.
#[derive(Serialize)]
struct Judged {
    id: String,
    paper: String,
    section: String,
    measured: String,
    condition: String,
    sql: String,
    requires: Option<Required>,
    judgments: Vec<Words>,
}

/// The requirement of a claim. If it isn't met, the claim isn't testable.
#[derive(Serialize)]
struct Required {
    measured: String,
    condition: String,
    sql: String,
}

/// A judgment in words.
#[derive(Serialize)]
struct Words {
    scenario: &'static str,
    /// The mean and its interval, in words.
    value: String,
    verdict: String,
    /// The verdict's class in the style sheet.
    class: &'static str,
    /// The p-value after Holm's correction. `None` if the judgment isn't a test.
    p: Option<String>,
    /// Whether the verdict stays the same after the correction.
    stands: bool,
    /// The requirement that isn't met, if the claim isn't testable.
    unmet: Option<String>,
    /// What each value belongs to: a seed, an episode or a dataset.
    each: &'static str,
    /// The number of datasets.
    datasets: String,
    /// The values, each with the number of its seed, episode or dataset.
    values: Vec<(String, String)>,
    /// The judgment as a picture. `None` without data.
    strip: Option<Strip>,
    /// The judgments under other readings.
    others: Vec<Beside>,
}

/// A judgment as a small picture. All positions are in percent of its width.
#[derive(Serialize)]
struct Strip {
    /// The condition's bound.
    bound: f64,
    /// The range in which the condition is satisfied: its beginning and its width.
    satisfied: [f64; 2],
    interval: [f64; 2],
    mean: f64,
    values: Vec<f64>,
}

impl Verdicts {
    /// Judges the claims with the runs of an analysis and, if a spec with readings is given, by these readings.
    ///
    /// # Errors
    /// When a claim's query is wrong, or a table is damaged.
    pub fn of(
        registry: &Registry,
        analysis: &Analysis,
        claims: &[&Claim],
        spec: Option<&Experiment>,
        quick: bool,
    ) -> Result<Self, ReportError> {
        let families = spec.map(|spec| Families::of(registry, claims, spec)).transpose()?;
        let judged: Vec<Vec<Judgment>> =
            claims.iter().map(|claim| judge(analysis, claim, quick)).collect::<Result<_, _>>()?;
        let all: Vec<&Judgment> = judged.iter().flatten().collect();
        let experiments: BTreeSet<String> =
            claims.iter().flat_map(|claim| claim.experiments(quick)).collect();
        let experiments: Vec<&str> = experiments.iter().map(String::as_str).collect();
        let mut p_values = corrected(all.iter().copied()).into_iter();
        let in_words = |(claim, judgments): (&&Claim, &Vec<Judgment>)| {
            let p_values = p_values.by_ref().take(judgments.len());
            let mut judged = Judged::new(claim, quick, judgments.iter().zip(p_values));
            for (words, judgment) in judged.judgments.iter_mut().zip(judgments) {
                words.others = families.as_ref().map(|all| all.beside(judgment)).unwrap_or_default();
            }
            judged
        };
        let lacking: Vec<&Judgment> =
            all.iter().copied().filter(|judgment| judgment.verdict() == Verdict::NoData).collect();
        let readings = families.as_ref().map(Families::counted).unwrap_or_default();
        let is_of_readings = lacking.len() == all.len() && !readings.is_empty();
        let mut claims: Vec<Judged> = claims.iter().zip(&judged).map(in_words).collect();
        if is_of_readings {
            claims.retain(|claim| claim.judgments.iter().any(|words| !words.others.is_empty()));
        }
        let lacking: BTreeSet<&String> = match is_of_readings {
            true => BTreeSet::new(),
            false => lacking.iter().flat_map(|judgment| &judgment.claim.experiments).collect(),
        };
        Ok(Self {
            claims,
            counts: Counts::of(&all),
            contacts: contacts(analysis, &experiments)?.iter().map(Contacts::to_string).collect(),
            readings,
            is_of_readings,
            commands: lacking.into_iter().filter_map(|name| analysis.command(name, quick)).collect(),
            mixed: all.iter().flat_map(|judgment| &judgment.mixed).map(Mixed::to_string).collect(),
        })
    }
}

/// The judgments by the readings of a spec.
struct Families<'a> {
    spec: &'a Experiment,
    matrix: Matrix<'a>,
    /// For each reading, the p-values of its judgments after Holm's correction.
    corrected: Vec<Vec<Option<f64>>>,
}

impl<'a> Families<'a> {
    fn of(registry: &Registry, claims: &[&'a Claim], spec: &'a Experiment) -> Result<Self, ReportError> {
        let matrix =
            Readings::of(registry, registry.recorded(), spec, claims, &[])?.judge(claims)?.without_empty();
        let places = 0..matrix.readings.len();
        let corrected = places.map(|place| corrected(matrix.column(place))).collect();
        Ok(Self { spec, matrix, corrected })
    }

    fn counted(&self) -> Vec<OfReading> {
        let of = |(name, judgments): (&str, Vec<&Judgment>)| {
            let counts = Counts::of(&judgments);
            let described = described(self.spec, name);
            OfReading { name: name.to_owned(), described, judged: counts.judged(), counts }
        };
        self.matrix.columns().map(of).collect()
    }

    /// The judgments under the readings of the same claim in the same scenario that have runs.
    fn beside(&self, own: &Judgment) -> Vec<Beside> {
        let is_same = |row: &MatrixRow| row.claim.id() == own.claim.id() && row.scenario == own.scenario;
        let Some(row) = self.matrix.rows.iter().position(is_same) else {
            return Vec::new();
        };
        let names = self.matrix.readings.iter().zip(&self.matrix.rows[row].judgments).zip(&self.corrected);
        names
            .filter(|((_, judgment), _)| judgment.verdict() != Verdict::NoData)
            .map(|((name, judgment), corrected)| Beside {
                reading: (*name).to_owned(),
                words: Words::new(judgment, corrected[row]),
            })
            .collect()
    }
}

impl Judged {
    fn new<'a>(
        claim: &Claim,
        quick: bool,
        judgments: impl Iterator<Item = (&'a Judgment<'a>, Option<f64>)>,
    ) -> Self {
        Self {
            id: claim.id().to_owned(),
            paper: claim.statement.clone(),
            section: claim.section.clone(),
            measured: claim.measured.clone(),
            condition: claim.condition.to_string(),
            sql: claim.sql(quick),
            requires: claim.requires.as_ref().map(|requirement| Required {
                measured: requirement.measured.clone(),
                condition: requirement.condition.to_string(),
                sql: claim.required_sql(quick).unwrap_or_default(),
            }),
            judgments: judgments.map(|(judgment, corrected)| Words::new(judgment, corrected)).collect(),
        }
    }
}

impl Words {
    fn new(judgment: &Judgment, corrected: Option<f64>) -> Self {
        let verdict = judgment.verdict();
        let several = judgment.measured.datasets() > 1;
        let is_difference = judgment.measured.minus.is_some();
        let place = |scenario: Option<Scenario>, (dataset, n): &(u64, i64)| {
            let scenario = scenario.filter(|_| is_difference);
            let number = match judgment.measured.each {
                Each::Dataset => dataset.to_string(),
                _ if several => format!("{n} of dataset {dataset}"),
                _ => n.to_string(),
            };
            scenario.map_or_else(|| number.clone(), |scenario| format!("{scenario} {number}"))
        };
        let groups = judgment.groups().into_iter();
        let values = groups.flat_map(|(scenario, values)| values.iter().map(move |of| (scenario, of)));
        Self {
            scenario: judgment.scenario.map_or("both", Scenario::name),
            value: judgment.interval().map_or_else(|| "no value".into(), |interval| interval.to_string()),
            verdict: verdict.to_string(),
            class: class_of(verdict),
            p: corrected.map(p_words),
            stands: judgment.stands(corrected),
            unmet: judgment.unmet().filter(|_| verdict == Verdict::NotTestable),
            each: judgment.measured.each.name(),
            datasets: counted(judgment.measured.datasets(), "dataset"),
            values: values.map(|(scenario, (at, value))| (place(scenario, at), rounded(*value))).collect(),
            strip: Strip::of(judgment),
            others: Vec::new(),
        }
    }
}

/// The class of a verdict in the style sheet.
pub fn class_of(verdict: Verdict) -> &'static str {
    match verdict {
        Verdict::Holds => "holds",
        Verdict::DoesNotHold => "fails",
        Verdict::NotTestable => "untestable",
        Verdict::NoData => "missing",
        Verdict::Undecided | Verdict::OneValue { .. } | Verdict::Mixed => "undecided",
    }
}

/// A p-value in words, with three decimals.
fn p_words(p: f64) -> String {
    if p < 0.001 { "p < 0.001".into() } else { format!("p = {p:.3}") }
}

impl Strip {
    fn of(judgment: &Judgment) -> Option<Self> {
        let interval = judgment.interval()?;
        let bound = judgment.claim.condition.bound();
        // The values of two scenarios are not differences, so they have no place beside the difference.
        let values = judgment.measured.values.values().filter(|_| judgment.measured.minus.is_none());
        let values: Vec<f64> = values.copied().collect();
        let all = || values.iter().copied().chain([bound, interval.low(), interval.high()]);
        let (low, high) = (all().fold(f64::INFINITY, f64::min), all().fold(f64::NEG_INFINITY, f64::max));
        let span = if high > low { high - low } else { 1.0 };
        // A margin of 6 % keeps all marks away from the edges.
        let at = |value: f64| ((6.0 + 88.0 * (value - low) / span) * 10.0).round() / 10.0;
        let satisfied = match judgment.claim.condition {
            Condition::Above(_) => [at(bound), 100.0 - at(bound)],
            Condition::Below(_) | Condition::Margin(_) => [0.0, at(bound)],
        };
        Some(Self {
            bound: at(bound),
            satisfied,
            interval: [at(interval.low()), at(interval.high())],
            mean: at(interval.mean),
            values: values.into_iter().map(at).collect(),
        })
    }
}
