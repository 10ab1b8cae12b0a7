// Distributions whose rows are means, followed by log-variances: [rows][2 * latent].

constexpr int WARP = 32;

// Draws latent states, [rows][latent].
extern "C" __global__ void draw(const float *posterior, const float *noise, float *drawn, int len, int latent) {
    int index = blockIdx.x * blockDim.x + threadIdx.x;
    if (index >= len) return;
    size_t mean = static_cast<size_t>(index / latent) * 2 * latent + index % latent;
    drawn[index] = posterior[mean] + expf(0.5f * posterior[mean + latent]) * noise[index];
}

// Computes the gradients of a posterior from those of the drawn states.
extern "C" __global__ void draw_gradients(
    const float *posterior, const float *drawn, const float *grad, float *of_posterior, int len, int latent) {
    int index = blockIdx.x * blockDim.x + threadIdx.x;
    if (index >= len) return;
    size_t mean = static_cast<size_t>(index / latent) * 2 * latent + index % latent;
    of_posterior[mean] = grad[index];
    // `drawn - mean` is `exp(log_variance / 2) * noise`.
    of_posterior[mean + latent] = 0.5f * grad[index] * (drawn[index] - posterior[mean]);
}

// The terms of the divergence in one dimension.
struct Terms {
    // Difference of the means, ratio of the variances, inverse of the prior's variance, and difference of the
    // log-variances: that of the prior, less that of the posterior.
    float distance, ratio, precision, log_ratio;

    __device__ Terms(const float *posterior, const float *prior, int index, int latent) {
        float log_prior = prior ? prior[latent + index] : 0.0f;
        log_ratio = log_prior - posterior[latent + index];
        distance = posterior[index] - (prior ? prior[index] : 0.0f);
        ratio = expf(-log_ratio);
        precision = expf(-log_prior);
    }

    __device__ float nats() const { return 0.5f * (log_ratio + ratio + distance * distance * precision - 1.0f); }
};

// Returns the divergence of one row. All lanes of a warp get it.
__device__ float row_nats(const float *posterior, const float *prior, int latent) {
    float nats = 0.0f;
    for (int index = threadIdx.x % WARP; index < latent; index += WARP)
        nats += Terms(posterior, prior, index, latent).nats();
    for (int step = WARP / 2; step > 0; step /= 2) nats += __shfl_xor_sync(0xffffffff, nats, step);
    return nats;
}

// Computes the divergence of each row from a prior, but at least `free`, or from the standard normal distribution if
// `prior` is null. A divergence that is not a number stays so. Each warp takes one row.
extern "C" __global__ void divergences(
    const float *posterior, const float *prior, float *nats, int rows, int latent, float free) {
    int row = (blockIdx.x * blockDim.x + threadIdx.x) / WARP;
    if (row >= rows) return;
    size_t first = static_cast<size_t>(row) * 2 * latent;
    float found = row_nats(posterior + first, prior ? prior + first : nullptr, latent);
    if (threadIdx.x % WARP == 0) nats[row] = prior && found < free ? free : found;
}

// Computes the mean of values times a factor. One block of 1024 threads takes all.
extern "C" __global__ void scaled_mean(const float *values, float *mean, int len, float factor) {
    __shared__ double parts[1024];
    double sum = 0.0;
    for (int index = threadIdx.x; index < len; index += blockDim.x) sum += values[index];
    parts[threadIdx.x] = sum;
    for (int half = blockDim.x / 2; half > 0; half /= 2) {
        __syncthreads();
        if (threadIdx.x < half) parts[threadIdx.x] += parts[threadIdx.x + half];
    }
    if (threadIdx.x == 0) *mean = static_cast<float>(parts[0] / len * factor);
}

// Computes the gradients of both distributions, given that of the mean divergence. Those of the posterior have the
// factor `representation`. Rows with a divergence of at most `free` have none. If `prior` is null, all rows have some.
extern "C" __global__ void divergence_gradients(
    const float *posterior, const float *prior, const float *grad, float *of_posterior, float *of_prior, int rows,
    int latent, float free, float representation) {
    int row = (blockIdx.x * blockDim.x + threadIdx.x) / WARP;
    if (row >= rows) return;
    size_t first = static_cast<size_t>(row) * 2 * latent;
    posterior += first;
    of_posterior += first;
    if (prior) {
        prior += first;
        of_prior += first;
    }
    bool counts = !prior || row_nats(posterior, prior, latent) > free;
    float of_row = *grad / rows;
    for (int index = threadIdx.x % WARP; index < latent; index += WARP) {
        Terms terms(posterior, prior, index, latent);
        float slope = of_row * terms.distance * terms.precision;
        of_posterior[index] = counts ? representation * slope : 0.0f;
        of_posterior[latent + index] = counts ? representation * 0.5f * of_row * (terms.ratio - 1.0f) : 0.0f;
        if (!prior) continue;
        float of_log = 0.5f * of_row * (1.0f - terms.ratio - terms.distance * terms.distance * terms.precision);
        of_prior[index] = counts ? -slope : 0.0f;
        of_prior[latent + index] = counts ? of_log : 0.0f;
    }
}
