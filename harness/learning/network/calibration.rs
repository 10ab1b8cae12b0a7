//! Recalibration of predicted distributions after a training.
//!
//! A network is more certain of the samples that it was trained on than of others. So the scales of each output are
//! multiplied by one factor, such that the score of the 90 % intervals of the validation samples is lowest, and its
//! logits of a contact by another, such that their loss is lowest (Guo et al., 2017, *On calibration of modern neural
//! networks*; Levi et al., 2022, *Evaluating and calibrating uncertainty prediction in regression tasks*). Both are
//! factors of the decoder's last layer, so that a recalibrated network has the same form as any other.

use super::head::{Head, heads};
use super::{Architecture, Parameters, Score};
use candle_core::{Result, Tensor, Var};
use harness_spec::{Family, Modality};
use std::collections::BTreeMap;

/// The binary logarithms of the factors that are tried. The best one is interpolated between them.
const TRIED: [f64; 13] = [-1.0, -0.75, -0.5, -0.25, 0.0, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 1.75, 2.0];

/// Returns this score of each output over the validation samples.
type Scores<'a> = dyn FnMut(Score) -> Result<BTreeMap<String, f64>> + 'a;

/// What a factor multiplies.
#[derive(Clone, Copy, PartialEq)]
enum Multiplied {
    /// The scales, of which the decoder's last layer gives the logarithms.
    Scales,
    /// The logits of a contact.
    Logits,
}

impl Architecture {
    /// Recalibrates the distributions that a trained decoder predicts. `scores` returns a score of each output over the
    /// validation samples, with the present `parameters`; nothing changes without validation samples.
    ///
    /// # Errors
    /// When candle can't compute a score.
    pub fn recalibrate(&self, parameters: &Parameters, scores: &mut Scores) -> Result<()> {
        let [vectors, _] = self.parts(&self.output);
        let (heads, _) = heads(self, &vectors);
        let layer = ["weight", "bias"].map(|part| parameters.get(&format!("decoder.vector.{part}")));
        let [Some(weight), Some(bias)] = layer else { return Ok(()) };
        for multiplied in [Multiplied::Scales, Multiplied::Logits] {
            let mut heads = heads.clone();
            heads.retain(|_, head| multiplied == Multiplied::Scales || head.family == Family::Hurdle);
            if !heads.is_empty() {
                Recalibration { heads, multiplied, layer: [weight, bias] }.run(scores)?;
            }
        }
        Ok(())
    }
}

/// One factor for each of these heads, and the layer whose outputs they multiply.
struct Recalibration<'a> {
    heads: BTreeMap<Modality, Head>,
    multiplied: Multiplied,
    layer: [&'a Var; 2],
}

impl Recalibration<'_> {
    fn run(&self, scores: &mut Scores) -> Result<()> {
        let score = match self.multiplied {
            Multiplied::Scales => Score::Intervals,
            Multiplied::Logits => Score::Loss,
        };
        let [weight, bias] = self.layer.map(|part| part.as_tensor().detach().copy());
        let trained = [weight?, bias?];
        let mut tried = Vec::new();
        for factor in TRIED {
            self.set(&trained, &|_| factor)?;
            tried.push(scores(score)?);
        }
        let of = |modality: Modality| {
            let scores: Option<Vec<f64>> =
                tried.iter().map(|scores| scores.get(&modality.to_string()).copied()).collect();
            scores.map_or(0.0, |scores| lowest(&scores))
        };
        self.set(&trained, &of)
    }

    /// Sets the layer to the trained one with factors, of which `of` returns the binary logarithm.
    fn set(&self, trained: &[Tensor; 2], of: &dyn Fn(Modality) -> f64) -> Result<()> {
        let columns = trained[1].elem_count();
        let (mut factors, mut added) = (vec![1f32; columns], vec![0f32; columns]);
        for (modality, head) in &self.heads {
            let factor = of(*modality).exp2();
            let first = head.parameters;
            match self.multiplied {
                Multiplied::Scales => added[first..first + head.width].fill(factor.ln() as f32),
                Multiplied::Logits => {
                    factors[first + head.width..first + 2 * head.width].fill(factor as f32);
                }
            }
        }
        let device = trained[1].device();
        let (factors, added) = (Tensor::new(factors, device)?, Tensor::new(added, device)?);
        let [weight, bias] = self.layer;
        weight.set(&trained[0].broadcast_mul(&factors.unsqueeze(1)?)?)?;
        bias.set(&((&trained[1] * factors)? + added)?)
    }
}

/// Returns where the scores at [`TRIED`] are lowest: the vertex of the parabola through the lowest of them and its
/// neighbors, or one of the ends. Equal scores, as without any contact, ask for no change.
fn lowest(scores: &[f64]) -> f64 {
    if scores.iter().all(|score| *score == scores[0]) {
        return 0.0;
    }
    let by_score = |a: &usize, b: &usize| scores[*a].total_cmp(&scores[*b]);
    let best = (0..TRIED.len()).min_by(by_score).unwrap_or_default();
    if best == 0 || best + 1 == TRIED.len() {
        return TRIED[best];
    }
    let [before, at, after] = [scores[best - 1], scores[best], scores[best + 1]];
    let (slope, curvature) = (after - before, after - 2.0 * at + before);
    let step = TRIED[best + 1] - TRIED[best];
    if curvature > 0.0 { TRIED[best] - step * slope / (2.0 * curvature) } else { TRIED[best] }
}
