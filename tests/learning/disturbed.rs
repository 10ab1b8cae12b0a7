//! Inputs as disturbed sensors give them.

use super::changes::bench;
use super::*;
use harness_samples::{Samples, physical};
use harness_spec::{Disturbance, Disturbances};

const ANGLES: Modality = Modality::PROPRIOCEPTION;

fn none() -> Disturbance {
    Disturbance::default()
}

/// The samples with a disturbed modality, by random streams of this purpose.
fn with(
    modality: Modality,
    disturbance: Disturbance,
    purpose: &str,
) -> (Arc<Samples>, Arc<Samples>, NormalizedData) {
    let data = Bench::new().data;
    let disturbed = data.disturbed(&Disturbances::from([(modality, disturbance)]), purpose).unwrap();
    (data.samples.clone(), disturbed.sensed().clone(), data)
}

/// What is added to the joint angles in each episode, `[episode, sample, joint]`, in deviations of each joint.
fn added(disturbance: Disturbance, purpose: &str) -> Vec<Vec<Vec<f32>>> {
    let (recorded, sensed, data) = with(ANGLES, disturbance, purpose);
    let std = &data.normalizers.modalities[&ANGLES].std;
    let of_sample = |sample: usize| {
        let [before, after] = [&recorded, &sensed].map(|samples| samples.vector(ANGLES, Sample::at(sample)));
        before.iter().zip(after).zip(std).map(|((before, after), std)| (after - before) / std).collect()
    };
    recorded.episodes().iter().map(|range| range.clone().map(of_sample).collect()).collect()
}

#[test]
fn noise_bias_and_drift_are_in_deviations_of_the_input() {
    let noise = added(Disturbance { noise: 0.5, ..none() }, "training");
    let all: Vec<f32> = noise.iter().flatten().flatten().copied().collect();
    let count = all.len() as f32;
    let [mean, square] = [1, 2].map(|power| all.iter().map(|value| value.powi(power)).sum::<f32>() / count);
    assert!(count > 900.0 && mean.abs() < 0.06 && (square.sqrt() - 0.5).abs() < 0.05, "{mean} {square}");
    // Another strength scales the same noise, and another purpose has other noise.
    let twice = added(Disturbance { noise: 1.0, ..none() }, "training");
    let scaled = |a: &f32, b: &f32| (2.0 * a - b).abs() < 1e-3;
    assert!(all.iter().zip(twice.iter().flatten().flatten()).all(|(a, b)| scaled(a, b)));
    assert_ne!(added(Disturbance { noise: 0.5, ..none() }, "test"), noise);

    let bias = added(Disturbance { bias: 0.5, ..none() }, "test");
    let drift = added(Disturbance { drift: 0.5, ..none() }, "test");
    for (bias, drift) in bias.iter().zip(&drift) {
        for (sample, (shift, drifted)) in bias.iter().zip(drift).enumerate() {
            // 10 samples take 1 s, in which the drift reaches its rate.
            let rate = &drift[10];
            assert!(shift.iter().zip(&bias[0]).all(|(a, b)| (a - b).abs() < 1e-3));
            assert!(drifted.iter().zip(rate).all(|(a, b)| (a - b * sample as f32 / 10.0).abs() < 1e-3));
        }
    }
    let first = |all: &[Vec<Vec<f32>>]| all.iter().map(|episode| episode[10][0]).collect::<Vec<f32>>();
    assert!(first(&bias)[0] != first(&bias)[1] && first(&drift)[0] != first(&drift)[1]);
    assert!(first(&bias)[0].abs() > 1e-3 && first(&drift)[0].abs() > 1e-3);
    // Each element has a shift of its own.
    let ratio = |all: &[Vec<Vec<f32>>], joint: usize| all[0][10][joint] / all[1][10][joint];
    assert!([&bias, &drift].iter().all(|all| (ratio(all, 0) - ratio(all, 1)).abs() > 1e-2));
}

#[test]
fn samples_that_are_late_or_lost_repeat_earlier_ones_of_the_episode() {
    let arrived = |disturbance, sample: usize| {
        let (recorded, sensed, _) = with(ANGLES, disturbance, "test");
        let range = &recorded.episodes()[1];
        let now = sensed.vector(ANGLES, Sample::at(range.start + sample));
        let is_it = |other: &usize| recorded.vector(ANGLES, Sample::at(range.start + other)) == now;
        (0..range.len()).find(is_it).unwrap()
    };
    let late: Vec<usize> = (0..6).map(|sample| arrived(Disturbance { delay: 2, ..none() }, sample)).collect();
    assert_eq!(late, [0, 0, 0, 1, 2, 3]);
    let lost: Vec<usize> =
        (0..12).map(|sample| arrived(Disturbance { dropped: 0.5, ..none() }, sample)).collect();
    let is_held = |pair: &[usize]| pair[1] == pair[0];
    assert!(
        lost.iter()
            .enumerate()
            .all(|(sample, from)| *from == sample || sample > 0 && *from == lost[sample - 1])
    );
    assert!(lost.windows(2).any(is_held) && !lost.windows(2).all(is_held), "{lost:?}");
    assert_eq!(arrived(Disturbance { dropped: 1.0, ..none() }, 9), 0);
    let (_, sensed, _) = with(ANGLES, Disturbance { dead: 1.0, ..none() }, "test");
    assert!(sensed.vectors(ANGLES).iter().all(|value| *value == 0.0));
    let (recorded, sensed, _) = with(ANGLES, Disturbance { only: vec![3, 0], ..none() }, "test");
    let width = recorded.layout()[ANGLES].width();
    for (place, (value, recorded)) in sensed.vectors(ANGLES).iter().zip(recorded.vectors(ANGLES)).enumerate()
    {
        assert_eq!(*value, if [0, 3].contains(&(place % width)) { *recorded } else { 0.0 });
    }
    // Nothing else changes.
    assert_eq!(sensed.vectors(Modality::ARM), recorded.vectors(Modality::ARM));
    assert_eq!(sensed.image(Modality::VISION), recorded.image(Modality::VISION));
}

#[test]
fn images_are_occluded_and_blurred() {
    let (recorded, sensed, _) = with(Modality::VISION, Disturbance { occlusion: 0.25, ..none() }, "test");
    let [rows, columns] = recorded.layout()[Modality::VISION].size().unwrap();
    let gray = |sample: usize| {
        let [before, after] =
            [&recorded, &sensed].map(|all| all.frame_bytes(Modality::VISION, Sample::at(sample)));
        let changed = before.iter().zip(after).enumerate().filter(|(_, (before, after))| before != after);
        changed.map(|(place, (_, after))| (place % (rows * columns), *after)).collect::<Vec<_>>()
    };
    let places: Vec<usize> = gray(0).iter().map(|(place, _)| *place).collect();
    let [low, high] =
        [places.iter().min().unwrap(), places.iter().max().unwrap()].map(|place| place / columns);
    assert!(gray(0).iter().all(|(_, value)| *value == 128) && high - low < rows / 2);
    // A pixel may be as gray before, so that fewer change.
    let quarter = 3 * rows * columns / 4;
    assert!(places.len() <= quarter && places.len() > quarter * 9 / 10, "{} {quarter}", places.len());
    let of = |samples: &Samples| physical(samples, Modality::VISION, &at(0..4));
    let blurred = |blur| of(&with(Modality::VISION, Disturbance { blur, ..none() }, "test").1);
    let differences = |values: &[f32]| values.windows(2).map(|pair| (pair[1] - pair[0]).abs()).sum::<f32>();
    let mean = |values: &[f32]| values.iter().sum::<f32>() / values.len() as f32;
    let sharp = of(&recorded);
    assert!((mean(&blurred(1.0)) - mean(&sharp)).abs() < 0.02);
    assert!(differences(&blurred(2.0)) < differences(&blurred(1.0)));
    assert!(differences(&blurred(1.0)) < 0.5 * differences(&sharp));
}

/// Each pixel of a blurred image is the mean of its surroundings, weighted by a normal distribution. Beyond the border
/// are the pixels of the border.
#[test]
fn a_blur_is_the_weighted_mean_of_the_surroundings() {
    let (recorded, sensed, _) = with(Modality::VISION, Disturbance { blur: 1.5, ..none() }, "test");
    let [rows, columns] = recorded.layout()[Modality::VISION].size().unwrap();
    let [before, after] = [&recorded, &sensed].map(|all| all.frame_bytes(Modality::VISION, Sample::at(3)));
    let weight = |distance: isize| (-0.5 * (distance as f64 / 1.5).powi(2)).exp();
    let within = |place: isize, side: usize| place.clamp(0, side as isize - 1) as usize;
    for (pixel, blurred) in after.iter().enumerate() {
        let (channel, row, column) = (pixel / (rows * columns), pixel / columns % rows, pixel % columns);
        let (mut sum, mut weights) = (0.0, 0.0);
        for (down, right) in (-9..=9).flat_map(|down| (-9..=9).map(move |right| (down, right))) {
            let (row, column) = (within(row as isize + down, rows), within(column as isize + right, columns));
            sum +=
                weight(down) * weight(right) * f64::from(before[(channel * rows + row) * columns + column]);
            weights += weight(down) * weight(right);
        }
        let difference = f64::from(*blurred) - sum / weights;
        assert!(difference.abs() <= 1.0, "channel {channel}, row {row}, column {column}: {difference}");
    }
}

#[test]
fn targets_are_not_disturbed_and_changes_are_added_to_what_was_given() {
    let data = bench(Memory::None, Family::None).0.data;
    let disturbances = Disturbances::from([(Modality::ARM, Disturbance { bias: 1.0, ..none() })]);
    let disturbed = data.disturbed(&disturbances, "test").unwrap();
    let (present, next) = (at(0..3), at(1..4));
    let target = |data: &NormalizedData, modality| {
        let targets = data.targets(&next, &present, &Default::default(), &[modality]).unwrap();
        targets.vectors(&[modality]).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap()
    };
    assert_eq!(target(&disturbed, ANGLES), target(&data, ANGLES));
    // Added to the disturbed position, the change gives the true one.
    let change = &data.normalizers.changes[&Modality::ARM];
    let given = disturbed.given_values(Modality::ARM, &present);
    assert_ne!(given, data.given_values(Modality::ARM, &present));
    let truth = physical(&data.samples, Modality::ARM, &next);
    for (place, value) in target(&disturbed, Modality::ARM).iter().enumerate() {
        let predicted = given[place] + value * change.std[place % change.std.len()];
        assert!((predicted - truth[place]).abs() < 1e-4, "{predicted} {}", truth[place]);
    }
    // No disturbance is that of the recording.
    assert!(Arc::ptr_eq(disturbed.disturbed(&Disturbances::new(), "test").unwrap().sensed(), &data.samples));
}
