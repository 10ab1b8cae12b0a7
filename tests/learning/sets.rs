//! Sets of objects: their order does not matter, and each object does.

use super::*;

/// Number of objects, each of two values.
const OBJECTS: usize = JOINTS / 2;

/// The finger's modalities, with the joint angles as a set.
fn layout() -> Arc<Layout> {
    let mut layout = Layout::clone(&Layout::finger());
    let angles = layout.modalities.iter_mut().find(|one| one.name == Modality::PROPRIOCEPTION).unwrap();
    angles.objects = Some(OBJECTS);
    Arc::new(layout)
}

fn architecture(input: &[Modality], fusion: Fusion) -> Architecture {
    Architecture {
        input: input.to_vec(),
        output: vec![Modality::CONTACT_FORCE],
        latent: 3,
        layout: layout(),
        action: ARM_JOINTS,
        network: Network { hidden: vec![32, 16], channels: Some(vec![2, 5]), fusion, ..network(0, 0) },
        arithmetic: Arithmetic::best(),
        changes: BTreeMap::new(),
        hurdles: BTreeMap::new(),
        distributions: BTreeMap::new(),
    }
}

/// Encodes `[batch, OBJECTS, 2]` angles with an arm of `[batch, 3]`, and images if the network sees some.
fn posterior(encoder: &dyn Encoder, angles: &Tensor, arm: &Tensor) -> Posterior {
    let batch = arm.dim(0).unwrap();
    let frames = normal(&mut random(8), &[batch, 3, 64, 64]);
    let observation = Observation::from_iter([
        (Modality::PROPRIOCEPTION, Value::Vector(angles.flatten(1, 2).unwrap())),
        (Modality::ARM, Value::Vector(arm.clone())),
        (Modality::VISION, Value::Frames(dense(&frames))),
    ]);
    encoder.encode(&observation).unwrap()
}

#[test]
fn networks_do_not_know_the_order_of_a_sets_objects() {
    let angles = normal(&mut random(4), &[3, OBJECTS, 2]);
    let arm = normal(&mut random(5), &[3, ARM_JOINTS]);
    let order: Vec<u32> = (0..OBJECTS as u32).rev().collect();
    let order = Tensor::new(order, &Device::Cpu).unwrap();
    let turned = angles.index_select(&order, 1).unwrap();
    // One value of one object is larger.
    let step: Vec<f32> = (0..2 * OBJECTS).map(|index| if index == 6 { 2.0 } else { 0.0 }).collect();
    let step = Tensor::from_vec(step, (1, OBJECTS, 2), &Device::Cpu).unwrap();
    let moved = angles.broadcast_add(&step).unwrap();
    let inputs: [&[Modality]; 3] = [
        &[Modality::PROPRIOCEPTION],
        &[Modality::PROPRIOCEPTION, Modality::ARM],
        &[Modality::PROPRIOCEPTION, Modality::ARM, Modality::VISION],
    ];
    for (input, fusion) in
        inputs.into_iter().flat_map(|input| Fusion::ALL.iter().map(move |fusion| (input, *fusion)))
    {
        let architecture = architecture(input, fusion);
        let mut parameters = Parameters::new();
        let encoder = architecture.encoder(&mut parameters, &mut random(0), &Device::Cpu).unwrap();
        let [plain, turned, moved] =
            [&angles, &turned, &moved].map(|one| posterior(&*encoder, one, &arm).mean());
        let (plain, moved) = (plain.unwrap(), moved.unwrap());
        assert_close(&turned.unwrap(), &plain, 1e-5, "the mean after another order");
        let change = (moved - &plain).unwrap().abs().unwrap().max_all().unwrap().to_scalar::<f32>().unwrap();
        assert!(change > 1e-3, "{input:?}, {fusion}: a change of one object changes the mean by {change}");
        // All parameters of the set are described, so that exported networks have them.
        architecture.decoder(&mut parameters, &mut random(0), &Device::Cpu).unwrap();
        assert!(parameters.keys().any(|name| name.contains("set_proprioception")));
        assert_eq!(described_parameters(&architecture), parameters.into_keys().collect::<Vec<_>>());
    }
}
