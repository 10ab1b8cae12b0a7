// Gated recurrent units and recurrent state-space models over whole sequences. Each pass is one kernel for all times.
//
// Sequences are independent of each other, so they are divided among groups of blocks. Each block of a group computes
// some of the units of all its group's sequences. It keeps the rows of the weights that it needs in shared memory, if
// they fit. The blocks of a group exchange values through global memory, and wait for each other at each time. All
// blocks must run at once, so the kernels are launched cooperatively.
//
// Values are [times][batch][columns].

// Number of threads in a block.
constexpr int THREADS = 512;
constexpr int WARP = 32;
constexpr unsigned ALL = 0xffffffff;
// Greatest number of sequences that a warp multiplies at once.
constexpr int TILE = 4;

// How the work is divided among blocks. The host computes it.
struct Division {
    int batch, times;
    // Number of sequences and of blocks in a group. The last group may have fewer sequences.
    int sequences, blocks;
    // Number of sequences that are multiplied at once, and the greatest number of values of one in a product.
    int tile, longest;
    // Whether the weights fit in shared memory.
    int stored;
};

extern __shared__ float4 shared_memory[];

__device__ float *shared_values() { return reinterpret_cast<float *>(shared_memory); }

__device__ void add_release(unsigned *count) {
    asm volatile("red.release.gpu.global.add.u32 [%0], 1;" ::"l"(count) : "memory");
}

__device__ unsigned load_acquire(const unsigned *count) {
    unsigned value;
    asm volatile("ld.acquire.gpu.global.u32 %0, [%1];" : "=r"(value) : "l"(count) : "memory");
    return value;
}

// Copies values to shared memory that other blocks may have written in this launch.
__device__ void copy(float *to, const float *from, int len) {
    size_t addresses = reinterpret_cast<size_t>(to) | reinterpret_cast<size_t>(from);
    bool aligned = (addresses | 4 * static_cast<size_t>(len)) % 16 == 0;
    if (aligned) {
        for (int index = threadIdx.x; index < len / 4; index += blockDim.x)
            reinterpret_cast<float4 *>(to)[index] = __ldcg(reinterpret_cast<const float4 *>(from) + index);
    } else {
        for (int index = threadIdx.x; index < len; index += blockDim.x) to[index] = __ldcg(from + index);
    }
}

// The group of blocks that this block belongs to.
struct Group {
    Division division;
    // The group's sequences: from `first` up to `end`.
    int first, end;
    // Index of this block in the group.
    int block;
    // Number of values in shared memory that are in use. The first ones are the factors of a product.
    int used;
    // Number of arrivals of the group's blocks: those counted so far, and those to wait for.
    unsigned *arrivals, awaited = 0;

    __device__ Group(Division division, unsigned *counts) : division(division) {
        int group = blockIdx.x / division.blocks;
        first = group * division.sequences;
        end = min(first + division.sequences, division.batch);
        block = blockIdx.x % division.blocks;
        used = division.tile * division.longest;
        arrivals = counts + group;
    }

    // Says that this block has written what the others wait for.
    __device__ void arrive() {
        __syncthreads();
        awaited += division.blocks;
        if (threadIdx.x == 0 && division.blocks > 1) add_release(arrivals);
    }

    // Waits for the blocks that have not arrived as often as this one.
    __device__ void wait() {
        if (threadIdx.x == 0 && division.blocks > 1)
            while (static_cast<int>(load_acquire(arrivals) - awaited) < 0) {}
        __syncthreads();
    }

    __device__ void barrier() {
        arrive();
        wait();
    }
};

// Adds the values of lanes whose numbers differ in the bit `HALF`, then those that differ in the lower bits. Each lane
// keeps the half of the values whose indices have the same bit as its number.
template <int HALF, int LEN> __device__ __forceinline__ void fold(float (&values)[LEN], int lane) {
    bool upper = lane & HALF;
#pragma unroll
    for (int index = 0; index < HALF; index++) {
        float low = values[index], high = values[index + HALF];
        values[index] = (upper ? high : low) + __shfl_xor_sync(ALL, upper ? low : high, HALF);
    }
    if constexpr (HALF > 1) fold<HALF / 2>(values, lane);
}

// Sums each of `LEN` values, a power of two, over the lanes of a warp. Returns the sum of value `lane % LEN`.
template <int LEN> __device__ __forceinline__ float totals(float (&values)[LEN], int lane) {
    fold<LEN / 2>(values, lane);
    float total = values[0];
#pragma unroll
    for (int step = LEN; step < WARP; step *= 2) total += __shfl_xor_sync(ALL, total, step);
    return total;
}

// A lane's terms of the products of `PARTS` rows with the factors of `TILE` sequences. The factors past `count`
// sequences repeat those of the last one.
template <int PARTS, int LEN>
__device__ __forceinline__ void add_terms(
    float (&sums)[LEN], const float *row, size_t part, size_t step, int length, int count, int lane) {
    const float *factors[TILE];
#pragma unroll
    for (int sequence = 0; sequence < TILE; sequence++)
        factors[sequence] = shared_values() + min(sequence, count - 1) * length;
#pragma unroll 4
    for (int index = lane; index < length; index += WARP) {
        float factor[TILE];
#pragma unroll
        for (int sequence = 0; sequence < TILE; sequence++) factor[sequence] = factors[sequence][index];
#pragma unroll
        for (int of = 0; of < PARTS; of++) {
            float weight = row[of * part + index * step];
#pragma unroll
            for (int sequence = 0; sequence < TILE; sequence++)
                sums[of * TILE + sequence] = fmaf(weight, factor[sequence], sums[of * TILE + sequence]);
        }
    }
}

// This block's part of a weight [PARTS * outputs][length], or of the transpose of [length][outputs].
template <int PARTS> struct Weight {
    // This block's outputs of each part: from `first` up to `end`.
    int first, end, length;
    // Where the rows begin in shared memory, if they fit.
    int start;
    // The row of the first output, and the distances of outputs, of parts, and of the values of a row.
    const float *rows;
    size_t output_step, part_step, step;

    __device__ Weight(Group &group, const float *weight, int outputs, int length, bool transposed = false)
        : length(length), start(group.used) {
        int share = (outputs + group.division.blocks - 1) / group.division.blocks;
        first = min(group.block * share, outputs);
        end = min(first + share, outputs);
        output_step = transposed ? 1 : length;
        step = transposed ? outputs : 1;
        part_step = outputs * output_step;
        rows = weight + first * output_step;
        if (!group.division.stored) return;
        int count = end - first;
        for (int part = 0; part < PARTS; part++) {
            float *to = shared_values() + group.used;
            group.used += count * length;
            if (!transposed) {
                copy(to, rows + part * part_step, count * length);
                continue;
            }
            for (int index = threadIdx.x; index < count * length; index += blockDim.x)
                to[index % count * length + index / count] = rows[index / count * step + index % count];
        }
    }

    // Multiplies the rows with `factors` [batch][length], those of one time, or with zeros if there are none. `before`
    // returns what is needed of an output and a sequence beside the product. `then` gets that and the products of all
    // parts. For each output and sequence, the same thread calls both in each product with as many outputs.
    template <class Before, class Then>
    __device__ void product(const Group &group, const float *factors, Before before, Then then) const {
        int lane = threadIdx.x % WARP;
        for (int sequence = group.first; sequence < group.end; sequence += group.division.tile) {
            int count = min(group.division.tile, group.end - sequence);
            __syncthreads();
            if (factors) copy(shared_values(), factors + static_cast<size_t>(sequence) * length, count * length);
            __syncthreads();
            for (int output = first + threadIdx.x / WARP; output < end; output += THREADS / WARP) {
                decltype(before(output, sequence)) given = {};
                if (lane < count) given = before(output, sequence + lane);
                constexpr int LEN = TILE * (PARTS == 3 ? 4 : PARTS);
                float sums[LEN] = {};
                if (factors && group.division.stored) {
                    const float *row = shared_values() + start + (output - first) * length;
                    add_terms<PARTS>(sums, row, (end - first) * length, 1, length, count, lane);
                } else if (factors) {
                    const float *row = rows + (output - first) * output_step;
                    add_terms<PARTS>(sums, row, part_step, step, length, count, lane);
                }
                float total = totals(sums, lane), products[PARTS];
#pragma unroll
                for (int part = 0; part < PARTS; part++)
                    products[part] = __shfl_sync(ALL, total, part * TILE + lane % TILE);
                if (lane < count) then(output, sequence + lane, given, products);
            }
        }
    }
};

// What `before` returns if nothing is needed.
struct Nothing {};

// The gates of a unit, and its product with the last state in the candidate.
struct __align__(16) Gates {
    float reset, update, candidate, hidden;
};

__device__ float logistic(float x) { return 1.0f / (1.0f + expf(-x)); }

// Computes the gates from the unit's products with its inputs and with the last state.
__device__ Gates gates_of(const float (&input)[3], const float (&hidden)[3]) {
    float reset = logistic(input[0] + hidden[0]);
    float update = logistic(input[1] + hidden[1]);
    return {reset, update, tanhf(input[2] + reset * hidden[2]), hidden[2]};
}

// Returns the state from the one before it.
__device__ float next_state(const Gates &gates, float last) {
    return gates.candidate + gates.update * (last - gates.candidate);
}

// Writes the gradients of a unit's products with its inputs and with the last state. `of_input` and `of_hidden` are
// rows [3 * width]. `grad` is the gradient of the state. Returns the part of the last state's gradient that does not
// pass through the product with it.
__device__ float unit_gradients(
    const Gates &gates, float last, float grad, float *of_input, float *of_hidden, int unit, int width) {
    float update = gates.update, candidate = gates.candidate, reset = gates.reset;
    float of_candidate = grad * (1.0f - update) * (1.0f - candidate * candidate);
    float of_update = grad * (last - candidate) * update * (1.0f - update);
    float of_reset = of_candidate * gates.hidden * reset * (1.0f - reset);
    of_input[unit] = of_hidden[unit] = of_reset;
    of_input[width + unit] = of_hidden[width + unit] = of_update;
    of_input[2 * width + unit] = of_candidate;
    of_hidden[2 * width + unit] = of_candidate * reset;
    return grad * update;
}

// What a gated recurrent unit's next state is computed from, beside the product with the last one.
struct Given {
    float input[3], last;
};

// Reads a unit's products with its inputs from a row [3 * width], and its last state.
__device__ Given given_of(const float *input, const float *last, int unit, int width) {
    return {{input[unit], input[width + unit], input[2 * width + unit]}, __ldcg(last + unit)};
}

// What a gated recurrent unit's gradients are computed from, beside the product with the next ones.
struct GivenBack {
    Gates gates;
    float last, grad;
};

extern "C" __global__ void __launch_bounds__(THREADS, 1) gru_forward(
    Division division, unsigned *counts, int width, const float *input, const float *weight, const float *bias,
    const float *start, float *states, Gates *gates) {
    Group group(division, counts);
    Weight<3> rows(group, weight, width, width);
    size_t state = static_cast<size_t>(division.batch) * width;
    for (int time = 0; time < division.times; time++) {
        const float *last = time ? states + (time - 1) * state : start;
        auto before = [&](int unit, int sequence) {
            size_t row = static_cast<size_t>(time) * division.batch + sequence;
            return given_of(input + row * 3 * width, last + static_cast<size_t>(sequence) * width, unit, width);
        };
        auto then = [&](int unit, int sequence, const Given &given, const float (&products)[3]) {
            float hidden[3];
            for (int part = 0; part < 3; part++) hidden[part] = products[part] + bias[part * width + unit];
            size_t index = time * state + static_cast<size_t>(sequence) * width + unit;
            gates[index] = gates_of(given.input, hidden);
            states[index] = next_state(gates[index], given.last);
        };
        rows.product(group, last, before, then);
        group.barrier();
    }
}

extern "C" __global__ void __launch_bounds__(THREADS, 1) gru_backward(
    Division division, unsigned *counts, int width, const Gates *gates, const float *weight, const float *start,
    const float *states, const float *grad, float *of_input, float *of_hidden, float *of_start) {
    Group group(division, counts);
    Weight<1> columns(group, weight, width, 3 * width, true);
    size_t state = static_cast<size_t>(division.batch) * width;
    // `of_start` holds the gradient of the state before each time. Each value is used by one thread only.
    for (int time = division.times - 1; time >= 0; time--) {
        bool is_last = time == division.times - 1;
        const float *last = time ? states + (time - 1) * state : start;
        auto before = [&](int unit, int sequence) {
            size_t of_state = static_cast<size_t>(sequence) * width + unit, index = time * state + of_state;
            return GivenBack{gates[index], last[of_state], grad[index] + (is_last ? 0.0f : of_start[of_state])};
        };
        auto then = [&](int unit, int sequence, const GivenBack &given, const float (&products)[1]) {
            size_t row = static_cast<size_t>(sequence) * width, of_row = 3 * (time * state + row);
            of_start[row + unit] = unit_gradients(
                given.gates, given.last, given.grad + products[0], of_input + of_row, of_hidden + of_row, unit, width);
        };
        columns.product(group, is_last ? nullptr : of_hidden + 3 * (time + 1) * state, before, then);
        group.barrier();
    }
    auto before = [&](int, int) { return Nothing{}; };
    auto then = [&](int unit, int sequence, Nothing, const float (&products)[1]) {
        of_start[static_cast<size_t>(sequence) * width + unit] += products[0];
    };
    columns.product(group, of_hidden, before, then);
}

// Sizes of a recurrent state-space model: the widths of its memory, of its hidden layer and of its latent state.
struct Model {
    int width, units, latent;
};

// The parameters of the products at each time, and the memory and the latent state before the first time, in the order
// in which they are packed.
template <class Value> struct Packed {
    Value *latent_weight, *memory_weight, *memory_bias, *hidden_weight, *weight, *bias, *memory, *latent;

    __device__ Packed(Value *packed, Model model, size_t batch) {
        size_t width = model.width, units = model.units;
        latent_weight = packed;
        memory_weight = latent_weight + 3 * width * model.latent;
        memory_bias = memory_weight + 3 * width * width;
        hidden_weight = memory_bias + 3 * width;
        weight = hidden_weight + units * width;
        bias = weight + 2 * model.latent * units;
        memory = bias + 2 * model.latent;
        latent = memory + batch * width;
    }
};

// The results are the memories and the distributions. The gates, the hidden layer's outputs and the latent states are
// kept for the backward pass.
extern "C" __global__ void __launch_bounds__(THREADS, 1) rssm_forward(
    Division division, unsigned *counts, Model model, const float *of_actions, const float *of_encoded,
    const float *packed, const float *noise, int is_drawn, float *memories, float *distributions, Gates *gates,
    float *hidden, float *latents) {
    Group group(division, counts);
    size_t batch = division.batch, width = model.width, units = model.units, latent = model.latent;
    Packed<const float> given(packed, model, batch);
    Weight<3> of_memory(group, given.memory_weight, width, width);
    Weight<3> of_latent(group, given.latent_weight, width, latent);
    Weight<1> of_hidden(group, given.hidden_weight, units, width);
    Weight<2> of_distribution(group, given.weight, latent, units);
    auto nothing = [&](int, int) { return Nothing{}; };
    // Keeps the unit's products with the memory in place of the gates that are computed from them.
    auto multiply_memory = [&](const float *memory, Gates *kept) {
        auto then = [&](int unit, int sequence, Nothing, const float (&products)[3]) {
            const float *bias = given.memory_bias + unit;
            kept[sequence * width + unit] = {
                products[0] + bias[0], products[1] + bias[width], products[2] + bias[2 * width], 0.0f};
        };
        of_memory.product(group, memory, nothing, then);
    };
    multiply_memory(given.memory, gates);
    for (int time = 0; time < division.times; time++) {
        size_t first = time * batch;
        const float *last_memory = time ? memories + (first - batch) * width : given.memory;
        const float *last_latent = time ? latents + (first - batch) * latent : given.latent;
        float *memory = memories + first * width;
        struct GivenUnit {
            Given given;
            Gates kept;
        };
        auto unit_before = [&](int unit, int sequence) {
            const float *input = of_actions + (first + sequence) * 3 * width;
            return GivenUnit{
                given_of(input, last_memory + sequence * width, unit, width), gates[(first + sequence) * width + unit]};
        };
        auto unit_then = [&](int unit, int sequence, const GivenUnit &of_unit, const float (&products)[3]) {
            const float hidden[3] = {of_unit.kept.reset, of_unit.kept.update, of_unit.kept.candidate};
            float input[3];
            for (int part = 0; part < 3; part++) input[part] = of_unit.given.input[part] + products[part];
            Gates found = gates_of(input, hidden);
            gates[(first + sequence) * width + unit] = found;
            memory[sequence * width + unit] = next_state(found, of_unit.given.last);
        };
        of_latent.product(group, last_latent, unit_before, unit_then);
        group.barrier();

        auto hidden_before = [&](int unit, int sequence) { return of_encoded[(first + sequence) * units + unit]; };
        auto hidden_then = [&](int unit, int sequence, float encoded, const float (&products)[1]) {
            float value = encoded + products[0];
            hidden[(first + sequence) * units + unit] = value < 0.0f ? 0.0f : value;
        };
        of_hidden.product(group, memory, hidden_before, hidden_then);
        group.arrive();
        if (time + 1 < division.times) multiply_memory(memory, gates + (first + batch) * width);
        group.wait();

        auto noise_before = [&](int index, int sequence) {
            return is_drawn ? noise[(first + sequence) * latent + index] : 0.0f;
        };
        auto latent_then = [&](int index, int sequence, float noise, const float (&products)[2]) {
            float *distribution = distributions + (first + sequence) * 2 * latent + index;
            float mean = products[0] + given.bias[index], log_variance = products[1] + given.bias[latent + index];
            distribution[0] = mean;
            distribution[latent] = log_variance;
            float drawn = is_drawn ? mean + expf(0.5f * log_variance) * noise : mean;
            latents[(first + sequence) * latent + index] = drawn;
        };
        of_distribution.product(group, hidden + first * units, noise_before, latent_then);
        group.barrier();
    }
}

// Computes the gradients of the products of all times, and those of the memory and the latent state before the first
// time.
extern "C" __global__ void __launch_bounds__(THREADS, 1) rssm_backward(
    Division division, unsigned *counts, Model model, const float *packed, const float *memories,
    const float *distributions, const float *grad_memories, const float *grad_distributions, int is_drawn,
    const Gates *gates, const float *hidden, const float *latents, float *of_input, float *of_product,
    float *of_hidden, float *of_distribution, float *of_packed) {
    Group group(division, counts);
    size_t batch = division.batch, width = model.width, units = model.units, latent = model.latent;
    Packed<const float> given(packed, model, batch);
    Packed<float> wanted(of_packed, model, batch);
    Weight<1> to_memory(group, given.memory_weight, width, 3 * width, true);
    Weight<1> to_latent(group, given.latent_weight, latent, 3 * width, true);
    Weight<1> from_hidden(group, given.hidden_weight, width, units, true);
    Weight<1> to_hidden(group, given.weight, units, 2 * latent, true);
    auto nothing = [&](int, int) { return Nothing{}; };
    // `wanted.memory` holds the gradient of the memory before each time. Each value is used by one thread only.
    auto add_to_memory = [&](int unit, int sequence, Nothing, const float (&products)[1]) {
        wanted.memory[sequence * width + unit] += products[0];
    };
    for (int time = division.times - 1; time >= 0; time--) {
        size_t first = time * batch, next = first + batch;
        bool is_last = time == division.times - 1;
        auto latent_before = [&](int index, int sequence) {
            size_t row = first + sequence;
            return is_drawn ? latents[row * latent + index] - distributions[row * 2 * latent + index] : 0.0f;
        };
        // The difference of a latent state and its mean is `exp(log_variance / 2) * noise`.
        auto latent_then = [&](int index, int sequence, float difference, const float (&products)[1]) {
            size_t mean = (first + sequence) * 2 * latent + index;
            of_distribution[mean] = grad_distributions[mean] + products[0];
            of_distribution[mean + latent] = grad_distributions[mean + latent] + 0.5f * products[0] * difference;
        };
        to_latent.product(group, is_last ? nullptr : of_input + next * 3 * width, latent_before, latent_then);
        group.arrive();
        if (!is_last) to_memory.product(group, of_product + next * 3 * width, nothing, add_to_memory);
        group.wait();

        auto hidden_before = [&](int unit, int sequence) { return hidden[(first + sequence) * units + unit]; };
        auto hidden_then = [&](int unit, int sequence, float output, const float (&products)[1]) {
            of_hidden[(first + sequence) * units + unit] = output > 0.0f ? products[0] : 0.0f;
        };
        to_hidden.product(group, of_distribution + first * 2 * latent, hidden_before, hidden_then);
        group.barrier();

        const float *last_memory = time ? memories + (first - batch) * width : given.memory;
        auto memory_before = [&](int unit, int sequence) {
            size_t state = sequence * width + unit, index = first * width + state;
            float grad = grad_memories[index] + (is_last ? 0.0f : wanted.memory[state]);
            return GivenBack{gates[index], last_memory[state], grad};
        };
        auto memory_then = [&](int unit, int sequence, const GivenBack &of_unit, const float (&products)[1]) {
            size_t row = (first + sequence) * 3 * width;
            wanted.memory[sequence * width + unit] = unit_gradients(
                of_unit.gates, of_unit.last, of_unit.grad + products[0], of_input + row, of_product + row, unit, width);
        };
        from_hidden.product(group, of_hidden + first * units, memory_before, memory_then);
        group.barrier();
    }
    to_memory.product(group, of_product, nothing, add_to_memory);
    auto write_latent = [&](int index, int sequence, Nothing, const float (&products)[1]) {
        wanted.latent[sequence * latent + index] = products[0];
    };
    to_latent.product(group, of_input, nothing, write_latent);
}
