# In a fresh clone, call `make run` or `make test`. Both do the set-up first.

# `make run` uses the spec's `quick` settings (minutes). `make run QUICK=` runs the full experiment (hours).
QUICK = --quick
# The Python package is built for tests with the profile of plain cargo, so that the dependencies are compiled once.
export MATURIN_PEP517_ARGS = --profile dev

.DEFAULT_GOAL := help
.PHONY: help setup run check test package python wheel wheel-trial docs soak lint bench interchange notebooks cluster

help: ## show this list
	@sed -n 's/^\([a-z-]*\):.*## /\1\t/p' $(MAKEFILE_LIST) | expand -t 12

setup: ## make .venv with MuJoCo; check EGL and Rust
	@setup/setup.sh

run: setup ## train the recommended network, in minutes; `make run QUICK=` at full scale
	cargo run --release -- run experiments/recommended.yaml $(QUICK)

check: setup ## verify a small change in about a minute: type-check everything, test the layers that changed
	@.ci/check

test: ## run every test, including those of the Python package; continue after failures
	@setup/setup.sh --test
	@worst=0; \
	cargo test --no-fail-fast || worst=1; \
	$(MAKE) --no-print-directory python || worst=1; \
	exit $$worst

package:
	@setup/setup.sh --python
	PATH="$(CURDIR)/.venv/bin:$$PATH" .venv/bin/python -m pip install \
		--quiet --disable-pip-version-check --no-build-isolation --no-deps .

python: package ## build the Python package into .venv and test it
	.venv/bin/python -m pytest --quiet --numprocesses auto --maxprocesses 4 tests/python_package

docs: package ## build the documentation site in target/docs; broken links are errors
	@setup/setup.sh --docs
	.venv/bin/python -m sphinx --quiet --fail-on-warning --fresh-env --conf-dir docs . target/docs
	@echo 'open target/docs/index.html'

# The platform of MuJoCo's own wheel. zig compiles and links for its C library, and auditwheel checks the result.
PLATFORM = manylinux_2_27
wheel: ## build dist/*.whl, which can be installed without Rust or a compiler (a quarter of an hour, once)
	@setup/setup.sh --wheel
	rm -rf target/wheels dist/soft_harness-*.whl
	PATH="$(CURDIR)/.venv-wheel/bin:$$PATH" maturin build --release --locked --zig --compatibility $(PLATFORM) \
		--auditwheel skip --out target/wheels
	PATH="$(CURDIR)/.venv-wheel/bin:$$PATH" auditwheel repair --only-plat --plat $(PLATFORM)_$(shell uname -m) \
		--exclude 'libmujoco.so.*' --wheel-dir dist target/wheels/soft_harness-*.whl

wheel-trial: ## install dist/*.whl in a bare Debian and run an experiment there (minutes; needs root and debootstrap)
	setup/wheel_trial.sh

soak: ## kill runs, searches and collections at many moments; fuzz every reader; compare foreign and random models (an hour)
	@setup/setup.sh --test
	@setup/setup.sh --models
	cargo test -- --ignored --nocapture

lint: setup ## check formatting, and that clippy has no warnings
	@cargo fmt --version >/dev/null && cargo clippy --version >/dev/null \
		|| { echo 'lint: rustfmt or clippy is missing; install both: rustup component add rustfmt clippy' >&2; exit 1; }
	cargo fmt --all --check
	cargo clippy --workspace --all-targets -- -D warnings

bench: ## compare the speed with PyTorch, Python's mujoco, PyBullet, MuJoCo in C, MLflow and DuckDB (over half an hour)
	@setup/setup.sh --bench
	cargo build --release --bins --examples
	.venv-bench/bin/python harness/benches/compare.py --output results/reference/benchmarks.parquet

interchange: ## test exports with LeRobot, Rerun, MLflow, TensorBoard, PyTorch, and imports (minutes; 6 GB once)
	@setup/setup.sh --interchange
	cargo build --bin harness
	.venv-interchange/bin/python -m pip install --quiet --no-deps .
	.venv-interchange/bin/python -m pytest tests/interchange
	.venv-interchange/bin/python -m pytest tests/python_package/test_networks.py tests/python_package/test_torch.py \
		tests/python_package/test_docstrings.py

cluster: ## run an experiment on a Slurm of four nodes on this machine, and kill its tasks (minutes; needs root)
	@setup/setup.sh --cluster
	cargo build --bin harness
	.venv/bin/python -m pytest tests/slurm

notebooks: ## run the notebooks and save their outputs (minutes; 5 GB of packages, once)
	@setup/setup.sh --notebooks
	.venv-notebooks/bin/python -m pip install --quiet --disable-pip-version-check \
		--no-deps .
	.venv-notebooks/bin/python -m nbconvert --to notebook --execute --inplace --ExecutePreprocessor.record_timing=False \
		python/notebooks/*.ipynb
