//! The claims and what becomes of them.

use crate::claims::{Claim, ClaimsError, Condition, Judgement, Verdict, judge};
use crate::numbers::rounded;
use crate::registry::Registry;
use crate::spec::Scenario;
use std::collections::BTreeSet;

/// All claims, judged.
pub struct Verdicts<'a> {
    pub claims: Vec<Judged<'a>>,
    /// The commands that make the runs of the claims without data.
    pub commands: BTreeSet<String>,
}

/// A claim and its judgements: one a scenario, or one alone.
pub struct Judged<'a> {
    pub claim: &'a Claim,
    pub sql: String,
    pub judgements: Vec<Judgement<'a>>,
}

impl<'a> Verdicts<'a> {
    /// # Errors
    /// When a claim's query is wrong, or a table damaged.
    pub fn of(registry: &Registry, claims: &'a [Claim], quick: bool) -> Result<Self, ClaimsError> {
        let judged = claims.iter().map(|claim| {
            Ok(Judged { claim, sql: claim.sql(quick), judgements: judge(registry, claim, quick)? })
        });
        let claims = judged.collect::<Result<Vec<_>, ClaimsError>>()?;
        let lacking =
            claims.iter().filter(|judged| judged.verdicts().any(|verdict| verdict == Verdict::NoData));
        let option = if quick { " --quick" } else { "" };
        let commands = lacking
            .flat_map(|judged| &judged.claim.experiments)
            .map(|experiment| format!("harness run experiments/{experiment}.yaml{option}"))
            .collect();
        Ok(Self { claims, commands })
    }

    /// How many judgements have a verdict of this [`class`].
    pub fn count(&self, wanted: &str) -> usize {
        self.claims.iter().flat_map(Judged::verdicts).filter(|verdict| class(*verdict) == wanted).count()
    }
}

impl Judged<'_> {
    fn verdicts(&self) -> impl Iterator<Item = Verdict> {
        self.judgements.iter().map(Judgement::verdict)
    }
}

/// What a verdict comes down to: `holds`, `fails` or `undecided`.
pub fn class(verdict: Verdict) -> &'static str {
    match verdict {
        Verdict::Holds => "holds",
        Verdict::DoesNotHold => "fails",
        Verdict::Undecided | Verdict::OneSeed { .. } | Verdict::NoData => "undecided",
    }
}

/// What a judgement is about.
pub fn scenario(judgement: &Judgement) -> &'static str {
    judgement.scenario.map_or("both", Scenario::name)
}

/// The mean and its interval in words.
pub fn value(judgement: &Judgement) -> String {
    judgement.interval().map_or_else(|| "no data".into(), |interval| interval.to_string())
}

/// Each seed's or episode's value in words.
pub fn values(judgement: &Judgement) -> Vec<(i64, String)> {
    judgement.measured.values.iter().map(|(each, value)| (*each, rounded(*value))).collect()
}

/// A judgement as a strip: where its numbers lie, in percent of its width.
pub struct Strip {
    /// The condition's bound.
    pub bound: f64,
    /// Where the condition is satisfied: from and how wide.
    pub satisfied: (f64, f64),
    pub interval: (f64, f64),
    pub mean: f64,
    pub values: Vec<f64>,
}

impl Strip {
    /// `None` without data.
    pub fn of(judgement: &Judgement) -> Option<Self> {
        let interval = judgement.interval()?;
        let (Condition::Above(bound) | Condition::Below(bound)) = judgement.claim.condition;
        let values: Vec<f64> = judgement.measured.values.values().copied().collect();
        let all = || values.iter().copied().chain([bound, interval.low(), interval.high()]);
        let (low, high) = (all().fold(f64::INFINITY, f64::min), all().fold(f64::NEG_INFINITY, f64::max));
        let span = if high > low { high - low } else { 1.0 };
        // Nothing lies at the very edge.
        let at = |value: f64| 6.0 + 88.0 * (value - low) / span;
        let (from, width) = match judgement.claim.condition {
            Condition::Above(_) => (at(bound), 100.0 - at(bound)),
            Condition::Below(_) => (0.0, at(bound)),
        };
        Some(Self {
            bound: at(bound),
            satisfied: (from, width),
            interval: (at(interval.low()), at(interval.high())),
            mean: at(interval.mean),
            values: values.into_iter().map(at).collect(),
        })
    }
}
