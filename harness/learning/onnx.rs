//! Trained networks as ONNX models, from their descriptions.
//!
//! A model takes and returns SI units and bytes, as users have them. Normalization is part of its graph. The batch is
//! the first axis, of any size. A network with memory takes its state as an input, and returns the next one. The
//! format: <https://github.com/onnx/onnx/blob/main/onnx/onnx.proto3>.

mod proto;

use crate::LearningError;
use crate::network::description::{
    ACTION, ActionTaken, Activation, Convolution, Description, ENCODED, IMAGES, LATENT, Layer, MEMORY,
    Operation, Output, POSTERIOR, PRIOR, Predicted, Quantity, SEEN, Scale, VECTORS,
};
use crate::tensors::TensorFile;
use harness_spec::{Element, Kind, Task};
use prost::Message;
use proto::{Attribute, Graph, Model, Node, Property, Tensor, ValueInfo};

/// Version of the file format (ONNX 1.12), which has the operators of [`OPERATORS`].
const FILE: i64 = 8;
/// Version of the operators. It is the first one with layer normalization.
const OPERATORS: i64 = 17;
/// Name of the first axis, whose size is not fixed.
const BATCH: &str = "batch";
/// Names of the outputs with the posterior of the latent state.
const MEAN: &str = "latent.mean";
const LOG_VARIANCE: &str = "latent.log_variance";
/// Names of the state that a network with memory takes, and of the one that it returns.
const STATE: &str = "state";
const NEXT_STATE: &str = "state.next";
/// Whether the sample is seen.
const IS_SEEN: &str = "seen.is";
/// Values of the last sample that the state of a network with memory consists of, in this order.
const LAST_MEMORY: &str = "state.memory";
const LAST_LATENT: &str = "state.latent";
const LAST_ACTION: &str = "state.action";
/// The parts of a gated recurrent unit, in the order of its weights.
const GATES: [&str; 3] = ["reset", "update", "candidate"];

/// A network file with its description.
pub struct Described {
    /// The description.
    pub description: Description,
    /// The tensors.
    pub file: TensorFile,
}

/// Returns the bytes of an ONNX model that applies the encoder of `prediction` and the decoder of `decoding`, which may
/// be the same network or a reconstruction. Inputs have the names of their modalities, and outputs too, after
/// `predicted.` or `reconstructed.`. `properties` are stored in the model, next to its description.
///
/// The model of a network with memory also takes `state`, which is zero for the first sample of an episode, and `seen`,
/// which is 1 for a sample that is seen and 0 for one that is not. It returns `state.next`, the state for the sample
/// after `action`.
pub fn model(
    prediction: &Described,
    decoding: &Described,
    properties: &[(&str, &str)],
) -> Result<Vec<u8>, LearningError> {
    let mut graph = Writer { tensors: &prediction.file, graph: Graph::default() };
    let (encoding, decoder) = (&prediction.description, &decoding.description);
    for input in &encoding.inputs {
        graph.input(input)?;
    }
    for value in [VECTORS, IMAGES] {
        let parts = encoding.inputs.iter().filter(|input| input.value == value);
        let parts: Vec<String> = parts.map(|input| normalized(input.name.name())).collect();
        if !parts.is_empty() {
            graph.node("Concat", &parts, in_part("encoder", value), vec![Attribute::int("axis", 1)]);
        }
    }
    graph.layers("encoder", &encoding.encoder)?;
    let memory = Remembered::of(encoding);
    match &memory {
        None => graph.posterior(in_part("encoder", POSTERIOR), encoding.latent),
        Some(memory) => {
            let belief = graph.memory(memory)?;
            graph.posterior(belief, encoding.latent);
        }
    }
    for output in changed(encoding) {
        let name = output.quantity.name.name();
        match &memory {
            None => graph.node("Identity", &[name], present(output), Vec::new()),
            Some(_) => graph.node("Where", &[IS_SEEN, name, &last(output)], present(output), Vec::new()),
        };
    }
    // A memory takes the action also if the decoder does not.
    if let Some(action) = decoder.action.as_ref().or(encoding.action.as_ref().filter(|_| memory.is_some())) {
        graph.action(action)?;
    }
    if let Some(memory) = &memory {
        graph.next_state(memory);
    }
    graph.tensors = &decoding.file;
    if decoder.action.is_some() {
        graph.node("Identity", &[normalized(ACTION)], in_part("decoder", ACTION), Vec::new());
    }
    graph.layers("decoder", &decoder.decoder)?;
    let prefix = if decoder.task == Task::Prediction.name() { "predicted" } else { "reconstructed" };
    for output in &decoder.outputs {
        graph.output(prefix, output)?;
    }
    graph.graph.name = decoder.task.to_owned();
    let description = decoder.json();
    let described = [("network", description.as_str())];
    let properties = properties.iter().chain(&described);
    Ok(Model {
        ir_version: FILE,
        producer_name: "harness".into(),
        producer_version: env!("CARGO_PKG_VERSION").into(),
        graph: Some(graph.graph),
        operators: vec![proto::OperatorSet { domain: String::new(), version: OPERATORS }],
        properties: properties
            .map(|(key, value)| Property { key: (*key).to_owned(), value: (*value).to_owned() })
            .collect(),
    }
    .encode_to_vec())
}

/// Returns the name of a value of the encoder or the decoder. Values that both have keep the names of the outputs.
fn in_part(part: &str, value: &str) -> String {
    if value == LATENT { MEAN.to_owned() } else { format!("{part}.{value}") }
}

fn normalized(name: &str) -> String {
    format!("{name}.normalized")
}

/// Lists elements with their units: `rotation (rad), lift (m)`.
fn units(elements: &[Element]) -> String {
    let listed = elements.iter().map(|element| match element.unit.as_str() {
        "" => element.name.clone(),
        unit => format!("{} ({unit})", element.name),
    });
    listed.collect::<Vec<_>>().join(", ")
}

/// Describes a modality's values for users of the model.
fn told(quantity: &Quantity) -> String {
    let values = match &quantity.kind {
        Kind::Vector { elements } => units(elements),
        Kind::Image { .. } if quantity.difference_of.is_some() => "rows, columns, RGB, in [-1, 1]".into(),
        Kind::Image { .. } => "rows, columns, RGB".into(),
    };
    format!("{}: {values}", quantity.meaning)
}

/// Shape of a modality in the network, without the batch.
fn inner_shape(quantity: &Quantity) -> Vec<usize> {
    match quantity.shape.as_slice() {
        [rows, columns, channels] => vec![*channels, *rows, *columns],
        shape => shape.to_vec(),
    }
}

/// The memory of a network.
struct Remembered<'a> {
    /// The layer that keeps what it computes, or a part of it, for the next sample.
    first: &'a Layer,
    /// The layers after it.
    others: &'a [Layer],
    /// Names and widths of the parts of the state.
    parts: Vec<(String, usize)>,
}

impl<'a> Remembered<'a> {
    /// Returns the memory of the described network; `None` if it has none.
    fn of(description: &'a Description) -> Option<Self> {
        let (first, others) = description.memory.split_first()?;
        let width = match first.operation {
            // The oldest of the last samples is left out.
            Operation::LastSamples { samples } => first.output[0] / samples * (samples - 1),
            _ => first.output[0],
        };
        let takes_latent = first.inputs.iter().any(|input| input == LATENT);
        let latent = takes_latent.then_some((LAST_LATENT, description.latent));
        let action = description.action.as_ref().map(|action| (LAST_ACTION, action.elements.len()));
        let own = [(LAST_MEMORY, width)].into_iter().chain(latent).chain(action);
        let own = own.map(|(part, width)| (part.to_owned(), width));
        // What a predicted change is added to is that of the last sample that was seen.
        let present = changed(description).map(|output| (last(output), output.quantity.shape[0]));
        let parts = own.chain(present).collect();
        Some(Self { first, others, parts })
    }

    /// Returns the width of the state.
    fn width(&self) -> usize {
        self.parts.iter().map(|(_, width)| width).sum()
    }
}

/// Returns the outputs that are predicted as changes.
fn changed(description: &Description) -> impl Iterator<Item = &Output> {
    description.outputs.iter().filter(|output| output.change.is_some())
}

/// Returns the name of the part of the state with an input of the last sample that was seen.
fn last(output: &Output) -> String {
    format!("{STATE}.{}", output.quantity.name)
}

/// Returns the name of the value of the present sample to which a change is added.
fn present(output: &Output) -> String {
    format!("{}.present", output.quantity.name)
}

/// Adds nodes to a graph. Constants come from `tensors`.
struct Writer<'a> {
    tensors: &'a TensorFile,
    graph: Graph,
}

impl Writer<'_> {
    /// Adds a node with one output, and returns the output's name.
    fn node(
        &mut self,
        operator: &str,
        inputs: &[impl ToString],
        output: String,
        attributes: Vec<Attribute>,
    ) -> String {
        self.graph.nodes.push(Node {
            inputs: inputs.iter().map(ToString::to_string).collect(),
            outputs: vec![output.clone()],
            name: output.clone(),
            operator: operator.into(),
            attributes,
        });
        output
    }

    /// Adds a tensor of the network's file as a constant, with `shape`, or its own if `None`, and returns its name.
    fn tensor(&mut self, name: &str, shape: Option<&[usize]>) -> Result<String, LearningError> {
        if self.graph.constants.iter().all(|constant| constant.name != name) {
            let found = self.tensors.tensors.get(name);
            let tensor = found
                .ok_or_else(|| candle_core::Error::Msg(format!("the network has no tensor '{name}'")))?;
            let values: Vec<f32> = tensor.flatten_all()?.to_vec1()?;
            self.graph.constants.push(Tensor::floats(name, shape.unwrap_or(tensor.dims()), &values));
        }
        Ok(name.to_owned())
    }

    /// Adds whole numbers as a constant and returns its name.
    fn numbers(&mut self, name: String, values: &[usize]) -> String {
        self.shape(name, &values.iter().map(|value| *value as i64).collect::<Vec<_>>())
    }

    /// Adds a shape as a constant and returns its name. A -1 stands for the size that remains.
    fn shape(&mut self, name: String, sizes: &[i64]) -> String {
        self.graph.constants.push(Tensor::shape(&name, sizes));
        name
    }

    /// Adds a number as a constant and returns its name.
    fn number(&mut self, name: String, value: f32) -> String {
        self.graph.constants.push(Tensor::floats(&name, &[], &[value]));
        name
    }

    /// Declares an input of the model.
    fn declare(&mut self, name: &str, kind: i32, shape: &[usize], told: String) {
        self.graph.inputs.push(ValueInfo::batch(name, kind, shape, told));
    }

    /// Declares an input modality and normalizes it.
    fn input(&mut self, quantity: &Quantity) -> Result<(), LearningError> {
        let name = quantity.name.name();
        let bytes = matches!(quantity.kind, Kind::Image { .. }) && quantity.difference_of.is_none();
        let kind = if bytes { proto::UINT8 } else { proto::FLOAT };
        self.declare(name, kind, &quantity.shape, told(quantity));
        let mut value = name.to_owned();
        if bytes {
            let float = Attribute::int("to", proto::FLOAT.into());
            value = self.node("Cast", &[value], format!("{name}.float"), vec![float]);
            let most = self.number(format!("{name}.bytes"), 255.0);
            value = self.node("Div", &[value, most], format!("{name}.unit"), Vec::new());
        }
        if matches!(quantity.kind, Kind::Image { .. }) {
            let order = Attribute::ints("perm", &[0, 3, 1, 2]);
            value = self.node("Transpose", &[value], format!("{name}.planes"), vec![order]);
        }
        self.normalize(name, &value, &quantity.scale, &inner_shape(quantity))
    }

    /// Normalizes `value`, the quantity `name`.
    fn normalize(
        &mut self,
        name: &str,
        value: &str,
        scale: &Scale,
        shape: &[usize],
    ) -> Result<(), LearningError> {
        let mean = self.tensor(&scale.mean, Some(shape))?;
        let deviation = self.tensor(&scale.deviation, None)?;
        let centred = self.node("Sub", &[value, &mean], format!("{name}.centred"), Vec::new());
        self.node("Div", &[centred, deviation], normalized(name), Vec::new());
        Ok(())
    }

    /// Adds a node that splits the columns of `value` into parts with these names and widths.
    fn split(&mut self, value: &str, parts: &[(impl ToString, usize)]) {
        let widths: Vec<usize> = parts.iter().map(|(_, width)| *width).collect();
        let widths = self.numbers(format!("{value}.widths"), &widths);
        self.graph.nodes.push(Node {
            inputs: vec![value.to_owned(), widths],
            outputs: parts.iter().map(|(name, _)| name.to_string()).collect(),
            name: format!("{value}.split"),
            operator: "Split".into(),
            attributes: vec![Attribute::int("axis", 1)],
        });
    }

    /// Declares the action and normalizes it.
    fn action(&mut self, action: &ActionTaken) -> Result<(), LearningError> {
        let shape = [action.elements.len()];
        self.declare(ACTION, proto::FLOAT, &shape, format!("{}: {}", action.form, units(&action.elements)));
        self.normalize(ACTION, ACTION, &action.scale, &shape)
    }

    /// Declares the state and whether the sample is seen, adds the layers of a memory, and returns the name of the
    /// distribution of the latent state.
    fn memory(&mut self, memory: &Remembered) -> Result<String, LearningError> {
        let told = "What the network knows of the samples before; zero for the first sample of an episode";
        self.declare(STATE, proto::FLOAT, &[memory.width()], told.to_owned());
        let told = "1 if the sample is seen; 0 if it is not, and its values are ignored";
        self.declare(SEEN, proto::FLOAT, &[1], told.to_owned());
        self.split(STATE, &memory.parts);
        let part = |value: &str| in_part(MEMORY, value);
        let half = self.number(format!("{SEEN}.half"), 0.5);
        let is_seen = self.node("Greater", &[SEEN, &half], IS_SEEN.to_owned(), Vec::new());
        let zero = self.number(format!("{SEEN}.zero"), 0.0);
        let posterior = in_part("encoder", POSTERIOR);
        self.node("Where", &[&is_seen, &posterior, &zero], part(ENCODED), Vec::new());
        let values: Vec<String> = memory
            .first
            .inputs
            .iter()
            .map(|input| match input.as_str() {
                ENCODED => part(ENCODED),
                LATENT => LAST_LATENT.to_owned(),
                ACTION => LAST_ACTION.to_owned(),
                other => other.to_owned(),
            })
            .collect();
        let inputs = self.node("Concat", &values, part("inputs"), vec![Attribute::int("axis", 1)]);
        match &memory.first.operation {
            Operation::GatedRecurrentUnit { input_weight, input_bias, hidden_weight, hidden_bias } => {
                let width = memory.first.output[0];
                self.gates("input", &inputs, [input_weight, input_bias], width)?;
                self.gates("hidden", LAST_MEMORY, [hidden_weight, hidden_bias], width)?;
                self.gated();
            }
            Operation::LastSamples { .. } => {
                let joined = [&inputs, LAST_MEMORY];
                self.node("Concat", &joined, part(MEMORY), vec![Attribute::int("axis", 1)]);
            }
            _ => {
                let problem = format!("'{}' is no layer of a memory", memory.first.name);
                return Err(candle_core::Error::Msg(problem).into());
            }
        }
        self.layers(MEMORY, memory.others)?;
        let posterior = part(POSTERIOR);
        let has_prior = memory.others.iter().any(|layer| layer.name == PRIOR);
        Ok(match has_prior {
            true => self.node("Where", &[&is_seen, &posterior, &part(PRIOR)], part("belief"), Vec::new()),
            false => posterior,
        })
    }

    /// Adds the product of a gated recurrent unit with `value`, and splits it into its three parts.
    fn gates(
        &mut self,
        name: &str,
        value: &str,
        [weight, bias]: [&String; 2],
        width: usize,
    ) -> Result<(), LearningError> {
        let (weight, bias) = (self.tensor(weight, None)?, self.tensor(bias, None)?);
        let product = in_part(MEMORY, name);
        self.node("Gemm", &[value, &weight, &bias], product.clone(), vec![Attribute::int("transB", 1)]);
        let parts = GATES.map(|gate| format!("{product}.{gate}"));
        self.split(&product, &parts.each_ref().map(|part| (part.as_str(), width)));
        Ok(())
    }

    /// Adds the gates of a gated recurrent unit, from the parts of both products.
    fn gated(&mut self) {
        let of = |product: &str, gate: &str| in_part(MEMORY, &format!("{product}.{gate}"));
        let [reset, update] = [GATES[0], GATES[1]].map(|gate| {
            let sum = of("sum", gate);
            self.node("Add", &[of("input", gate), of("hidden", gate)], sum.clone(), Vec::new());
            self.node("Sigmoid", &[sum], in_part(MEMORY, gate), Vec::new())
        });
        let candidate = GATES[2];
        let kept = self.node("Mul", &[reset, of("hidden", candidate)], of("kept", candidate), Vec::new());
        let sum = self.node("Add", &[of("input", candidate), kept], of("sum", candidate), Vec::new());
        let candidate = self.node("Tanh", &[sum], in_part(MEMORY, candidate), Vec::new());
        let change = self.node("Sub", &[LAST_MEMORY, &candidate], in_part(MEMORY, "change"), Vec::new());
        let update = self.node("Mul", &[update, change], in_part(MEMORY, "updated"), Vec::new());
        self.node("Add", &[candidate, update], in_part(MEMORY, MEMORY), Vec::new());
    }

    /// Puts the parts of the next state together, and declares it as an output.
    fn next_state(&mut self, memory: &Remembered) {
        let mut kept = in_part(MEMORY, MEMORY);
        if matches!(memory.first.operation, Operation::LastSamples { .. }) {
            let start = self.numbers(format!("{NEXT_STATE}.start"), &[0]);
            let end = self.numbers(format!("{NEXT_STATE}.end"), &[memory.parts[0].1]);
            let axis = self.numbers(format!("{NEXT_STATE}.axis"), &[1]);
            kept = self.node("Slice", &[kept, start, end, axis], in_part(MEMORY, "kept"), Vec::new());
        }
        let next = |(part, _): &(String, usize)| match part.as_str() {
            LAST_LATENT => MEAN.to_owned(),
            LAST_ACTION => normalized(ACTION),
            LAST_MEMORY => kept.clone(),
            part => format!("{}.present", part.strip_prefix("state.").unwrap_or(part)),
        };
        let parts: Vec<String> = memory.parts.iter().map(next).collect();
        self.node("Concat", &parts, NEXT_STATE.to_owned(), vec![Attribute::int("axis", 1)]);
        let told = "The state for the sample after the action".to_owned();
        self.graph.outputs.push(ValueInfo::batch(NEXT_STATE, proto::FLOAT, &[memory.width()], told));
    }

    /// Splits the posterior, and declares both halves as outputs.
    fn posterior(&mut self, posterior: String, latent: usize) {
        self.split(&posterior, &[(MEAN, latent), (LOG_VARIANCE, latent)]);
        let outputs = [MEAN, LOG_VARIANCE];
        for (name, told) in outputs.into_iter().zip(["mean", "logarithm of the variance"]) {
            let told = format!("The posterior's {told} of the latent state");
            self.graph.outputs.push(ValueInfo::batch(name, proto::FLOAT, &[latent], told));
        }
    }

    /// Converts a modality that the decoder has computed to SI units, and declares it as an output.
    fn output(&mut self, prefix: &str, output: &Output) -> Result<(), LearningError> {
        let Output { quantity, change, minimum, softmax, distribution, .. } = output;
        let name = format!("{prefix}.{}", quantity.name);
        let shape = inner_shape(quantity);
        let mut value = self.columns(format!("{name}.normalized"), quantity.value, quantity.start, shape[0]);
        let (base, deviation) = match change {
            Some(change) => (present(output), change),
            None => (self.tensor(&quantity.scale.mean, Some(&shape))?, &quantity.scale.deviation),
        };
        let deviation = self.tensor(deviation, None)?;
        value = self.node("Mul", &[&value, &deviation], format!("{name}.scaled"), Vec::new());
        value = self.node("Add", &[value, base], format!("{name}.shifted"), Vec::new());
        if let Some(distribution) = distribution {
            value = self.distribution(&name, output, distribution, [value, deviation])?;
        }
        if *softmax {
            let attributes = vec![Attribute::int("axis", 1)];
            value = self.node("Softmax", &[value], format!("{name}.probabilities"), attributes);
        }
        if let Some(minimum) = minimum {
            let minimum = self.number(format!("{name}.minimum"), *minimum as f32);
            value = self.node("Max", &[value, minimum], format!("{name}.bounded"), Vec::new());
        }
        let image = matches!(quantity.kind, Kind::Image { .. });
        let order = Attribute::ints("perm", &[0, 2, 3, 1]);
        let (operator, attributes) =
            if image { ("Transpose", vec![order]) } else { ("Identity", Vec::new()) };
        self.node(operator, &[value], name.clone(), attributes);
        self.graph.outputs.push(ValueInfo::batch(&name, proto::FLOAT, &quantity.shape, told(quantity)));
        Ok(())
    }

    /// Adds a node that takes columns or channels of a value of the decoder.
    fn columns(&mut self, name: String, value: &str, start: usize, count: usize) -> String {
        let first = self.numbers(format!("{name}.start"), &[start]);
        let end = self.numbers(format!("{name}.end"), &[start + count]);
        let axis = self.numbers(format!("{name}.axis"), &[1]);
        self.node("Slice", &[in_part("decoder", value), first, end, axis], name, Vec::new())
    }

    /// Declares the parameters of a distribution as outputs, and returns the value of the mean. `value` is the value of
    /// the columns of the mean in SI units, which are those of the location for a hurdle, and `deviation` is their unit.
    fn distribution(
        &mut self,
        name: &str,
        output: &Output,
        distribution: &Predicted,
        [value, deviation]: [String; 2],
    ) -> Result<String, LearningError> {
        let (quantity, width) = (&output.quantity, output.quantity.shape[0]);
        let declare = |graph: &mut Self, part: &str, told: &str| {
            let told = format!("{}: {told}", quantity.meaning);
            graph.graph.outputs.push(ValueInfo::batch(
                &format!("{name}.{part}"),
                proto::FLOAT,
                &[width],
                told,
            ));
        };
        let node = |graph: &mut Self, operator: &str, inputs: &[&str], part: &str| {
            graph.node(operator, inputs, format!("{name}.{part}"), Vec::new())
        };
        let raw = self.columns(format!("{name}.scale.raw"), quantity.value, distribution.start, width);
        let least = self.number(format!("{name}.scale.least"), distribution.least_scale as f32);
        let greatest = self.number(format!("{name}.scale.greatest"), distribution.greatest_logarithm as f32);
        let bounded = node(self, "Min", &[&raw, &greatest], "scale.bounded");
        let positive = node(self, "Exp", &[&bounded], "scale.positive");
        let normalized = node(self, "Add", &[&positive, &least], "scale.normalized");
        let scale = node(self, "Mul", &[&normalized, &deviation], "scale");
        let Some(threshold) = distribution.threshold else {
            declare(self, "scale", "the standard deviation, before values below the minimum are set to it");
            return Ok(value);
        };
        declare(self, "scale", "given a contact, the mean absolute deviation of the Laplace distribution");
        let logits =
            self.columns(format!("{name}.logits"), quantity.value, distribution.start + width, width);
        let touches = node(self, "Sigmoid", &[&logits], "touch");
        declare(self, "touch", "the probability of a contact");
        let threshold = self.number(format!("{name}.threshold"), threshold);
        let above = node(self, "Sub", &[&value, &threshold], "above.raw");
        let above = node(self, "Div", &[&above, &deviation], "above.normalized");
        let above = node(self, "Softplus", &[&above], "above.positive");
        let above = node(self, "Mul", &[&above, &deviation], "above");
        let location = node(self, "Add", &[&above, &threshold], "location");
        declare(
            self,
            "location",
            "given a contact, the mean of a Laplace distribution of which the values above 0.05 N are left",
        );
        // The share of the distribution below the threshold, and what leaving it out adds to the mean given a contact.
        let [half, one] =
            [("half", 0.5), ("one", 1.0)].map(|(part, number)| self.number(format!("{name}.{part}"), number));
        let place = node(self, "Div", &[&above, &scale], "place");
        let exponent = node(self, "Neg", &[&place], "exponent");
        let density = node(self, "Exp", &[&exponent], "density");
        let below = node(self, "Mul", &[&density, &half], "below");
        let left = node(self, "Sub", &[&one, &below], "left");
        let next = node(self, "Add", &[&place, &one], "place.next");
        let share = node(self, "Mul", &[&next, &below], "share");
        let ratio = node(self, "Div", &[&share, &left], "ratio");
        let shift = node(self, "Mul", &[&ratio, &scale], "shift");
        let given_contact = node(self, "Add", &[&location, &shift], "given_contact");
        Ok(node(self, "Mul", &[&touches, &given_contact], "mean"))
    }

    /// Adds the layers of the encoder or the decoder.
    fn layers(&mut self, part: &str, layers: &[Layer]) -> Result<(), LearningError> {
        for layer in layers {
            self.layer(part, layer)?;
        }
        Ok(())
    }

    fn layer(&mut self, part: &str, layer: &Layer) -> Result<(), LearningError> {
        let output = in_part(part, &layer.name);
        let inputs: Vec<String> = layer.inputs.iter().map(|input| in_part(part, input)).collect();
        match &layer.operation {
            Operation::Concatenate => {
                self.node("Concat", &inputs, output, vec![Attribute::int("axis", 1)]);
            }
            Operation::Columns { ranges } => {
                let columns: Vec<usize> =
                    ranges.iter().flat_map(|[start, len]| *start..start + len).collect();
                let columns = self.numbers(format!("{output}.columns"), &columns);
                self.node("Gather", &[&inputs[0], &columns], output, vec![Attribute::int("axis", 1)]);
            }
            Operation::Objects { start, .. } => self.objects(&inputs[0], output, *start, &layer.output),
            Operation::SumAndMaximum { objects } => {
                self.sum_and_maximum(&inputs[0], output, *objects, layer.output[0] / 2);
            }
            Operation::ProductOfExperts { least_log_variance } => {
                self.product(&inputs, &output, layer.output[0] / 2, *least_log_variance);
            }
            Operation::Average { size } => {
                let sides = [*size as i64; 2];
                let attributes =
                    vec![Attribute::ints("kernel_shape", &sides), Attribute::ints("strides", &sides)];
                self.node("AveragePool", &inputs, output, attributes);
            }
            Operation::Flatten => {
                self.node("Flatten", &inputs, output, vec![Attribute::int("axis", 1)]);
            }
            Operation::Reshape => {
                // A 0 keeps the size of the batch.
                let shape =
                    self.numbers(format!("{output}.shape"), &[&[0], layer.output.as_slice()].concat());
                self.node("Reshape", &[&inputs[0], &shape], output, Vec::new());
            }
            Operation::Dense { weights, bias, activation } => {
                let mut sum = self.tensor(bias, None)?;
                for (index, (input, weight)) in inputs.iter().zip(weights).enumerate() {
                    let weight = self.tensor(weight, None)?;
                    let name = self.before(&output, *activation, index + 1 == weights.len(), index);
                    sum = self.node("Gemm", &[input, &weight, &sum], name, vec![Attribute::int("transB", 1)]);
                }
                self.activate(sum, output, *activation);
            }
            Operation::Convolution(convolution) => self.convolution("Conv", &inputs, output, convolution)?,
            Operation::TransposedConvolution(convolution) => {
                self.convolution("ConvTranspose", &inputs, output, convolution)?;
            }
            Operation::GatedRecurrentUnit { .. } | Operation::LastSamples { .. } => {
                let problem = format!("'{}' is not the first layer of a memory", layer.name);
                return Err(candle_core::Error::Msg(problem).into());
            }
            Operation::LayerNormalization { weight, bias, epsilon } => {
                let (weight, bias) = (self.tensor(weight, None)?, self.tensor(bias, None)?);
                let attributes =
                    vec![Attribute::int("axis", -1), Attribute::float("epsilon", *epsilon as f32)];
                self.node("LayerNormalization", &[&inputs[0], &weight, &bias], output, attributes);
            }
        }
        Ok(())
    }

    /// Adds nodes that compute the product of Gaussian distributions and of the standard normal distribution.
    fn product(&mut self, experts: &[String], output: &str, latent: usize, least: f64) {
        let least = self.number(format!("{output}.least"), least as f32);
        let mut precision = self.number(format!("{output}.one"), 1.0);
        let mut weighted = self.number(format!("{output}.zero"), 0.0);
        for expert in experts {
            let of = |part: &str| format!("{expert}.{part}");
            self.split(expert, &[(of("mean"), latent), (of("log_variance"), latent)]);
            let bounded = self.node("Max", &[&of("log_variance"), &least], of("bounded"), Vec::new());
            let negative = self.node("Neg", &[bounded], of("negative"), Vec::new());
            let own = self.node("Exp", &[negative], of("precision"), Vec::new());
            let part = self.node("Mul", &[&of("mean"), &own], of("weighted"), Vec::new());
            precision = self.node("Add", &[precision, own], of("precisions"), Vec::new());
            weighted = self.node("Add", &[weighted, part], of("sum"), Vec::new());
        }
        let mean = self.node("Div", &[&weighted, &precision], format!("{output}.mean"), Vec::new());
        let logarithm = self.node("Log", &[precision], format!("{output}.logarithm"), Vec::new());
        let log_variance = self.node("Neg", &[logarithm], format!("{output}.log_variance"), Vec::new());
        self.node("Concat", &[mean, log_variance], output.to_owned(), vec![Attribute::int("axis", 1)]);
    }

    /// Adds nodes that make the objects of a set rows of a batch.
    fn objects(&mut self, vectors: &str, output: String, start: usize, shape: &[usize]) {
        let columns: Vec<usize> = (start..start + shape.iter().product::<usize>()).collect();
        let columns = self.numbers(format!("{output}.columns"), &columns);
        let attributes = vec![Attribute::int("axis", 1)];
        let of_set = self.node("Gather", &[vectors, &columns], format!("{output}.set"), attributes);
        let rows = self.shape(format!("{output}.shape"), &[-1, shape[1] as i64]);
        self.node("Reshape", &[of_set, rows], output, Vec::new());
    }

    /// Adds nodes that compute the sum and the maximum over the objects of each sample.
    fn sum_and_maximum(&mut self, rows: &str, output: String, objects: usize, width: usize) {
        let shape = self.shape(format!("{output}.shape"), &[-1, objects as i64, width as i64]);
        let samples = self.node("Reshape", &[rows, &shape], format!("{output}.samples"), Vec::new());
        let axis = self.numbers(format!("{output}.axis"), &[1]);
        // In this version of the operators, the axes are an input of one and an attribute of the other.
        let keep = Attribute::int("keepdims", 0);
        let sum = self.node("ReduceSum", &[&samples, &axis], format!("{output}.sum"), vec![keep.clone()]);
        let axes = vec![Attribute::ints("axes", &[1]), keep];
        let parts = [sum, self.node("ReduceMax", &[&samples], format!("{output}.maximum"), axes)];
        self.node("Concat", &parts, output, vec![Attribute::int("axis", 1)]);
    }

    fn convolution(
        &mut self,
        operator: &str,
        inputs: &[String],
        output: String,
        Convolution { weight, bias, stride, padding, activation }: &Convolution,
    ) -> Result<(), LearningError> {
        let (weight, bias) = (self.tensor(weight, None)?, self.tensor(bias, None)?);
        let attributes = vec![
            Attribute::ints("strides", &[*stride as i64; 2]),
            Attribute::ints("pads", &[*padding as i64; 4]),
        ];
        let name = self.before(&output, *activation, true, 0);
        let sum = self.node(operator, &[&inputs[0], &weight, &bias], name, attributes);
        self.activate(sum, output, *activation);
        Ok(())
    }

    /// Returns the name of a layer's sum: the layer's own name if it is the last one and no activation follows.
    fn before(&self, output: &str, activation: Activation, last: bool, index: usize) -> String {
        if last && activation == Activation::None {
            output.to_owned()
        } else {
            format!("{output}.sum{index}")
        }
    }

    /// Adds the activation after `sum`, if there is one.
    fn activate(&mut self, sum: String, output: String, activation: Activation) {
        if activation == Activation::Relu {
            self.node("Relu", &[sum], output, Vec::new());
        }
    }
}
