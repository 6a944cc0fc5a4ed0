# Every target sets up what it needs. Wanted of the machine: a Rust toolchain (cargo, clippy,
# rustfmt), Python 3 with pip, a C compiler, and the crates and Python package registries.
#
# Everything is compiled once, in the release profile and for the whole workspace: the network
# library takes about nine minutes on two cores, and any other choice of profile or of features
# would compile it again. The build folder lies in the user's cache, shared by all checkouts.

SHELL  := bash
CACHE  := $(or $(XDG_CACHE_HOME),$(HOME)/.cache)/barchan
PYTHON ?= python3

CARGO_TARGET_DIR ?= $(CACHE)/target
export CARGO_TARGET_DIR
# Where the cargo commands get further flags, such as --locked.
CARGO_FLAGS ?=
CARGO_BUILD  = --release --workspace $(CARGO_FLAGS)

BARCHAN := $(CARGO_TARGET_DIR)/release/barchan
# What `make libtorch` leaves.
TORCH = $(CACHE)/libtorch/2.9.1
# What `make run` works on, and where it writes.
DATA = synth:seed=1,frames=40
OUT  = runs/demo
# What `make accuracy` and `make load` judge.
MODEL = rover

PEERS := $(CACHE)/peers-$(shell sha256sum tests/peers/requirements.txt | cut -c 1-12)
TORCH_PINS := tests/peers/requirements-torch.txt scripts/torch_cpu.py scripts/libtorch.py
PEERS_TORCH := $(CACHE)/peers-torch-$(shell cat $(TORCH_PINS) | sha256sum | cut -c 1-12)

.DEFAULT_GOAL := help
.PHONY: help build run test bench lint smoke tch weights vocabularies peers accuracy peers-torch onnx-weights onnxruntime libtorch sample-data fuzz faults load dist clean

help: ## this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-12s %s\n", $$1, $$2 }' Makefile

build: ## the barchan program
	cargo build $(CARGO_BUILD)

run: build onnxruntime ## the main job: train, export, infer, slam, map; DATA=folder:PATH for your images, OUT=DIR
	scripts/main-job.sh "$(BARCHAN)" "$(DATA)" "$(OUT)"

test: onnxruntime ## every test
	cargo test $(CARGO_BUILD)

smoke: onnxruntime ## train for a moment on each CPU device, export, ONNX Runtime against Burn
	cargo test $(CARGO_BUILD) --test end_to_end smoke -- --nocapture

# libtorch's other features of the network library would compile all of it again in the build folder
# of everything else: it has a folder of its own. The path to libtorch goes into the program; the
# tests of the library crates find it by the variable.
tch: export CARGO_TARGET_DIR := $(CARGO_TARGET_DIR)-tch
tch: export LIBTORCH := $(TORCH)
tch: export LD_LIBRARY_PATH := $(TORCH)/lib:$(LD_LIBRARY_PATH)
tch: onnxruntime libtorch ## the program with libtorch for train --device tch, and a few steps on it (15 minutes)
	cargo build $(CARGO_BUILD) --features tch
	cargo test $(CARGO_BUILD) --features tch --test end_to_end smoke::tch -- --nocapture
	@echo "with libtorch: $(CARGO_TARGET_DIR)/release/barchan"

lint: ## format, clippy, documentation and licences, warnings denied
	cargo fmt --all --check
	cargo clippy $(CARGO_BUILD) --all-targets -- -D warnings
	$(PYTHON) scripts/licences.py > /dev/null
	if cargo deny --version > /dev/null 2>&1; then cargo deny check bans licenses sources; else echo "cargo-deny is not installed: licences.py alone judged"; fi
	RUSTDOCFLAGS="-D warnings" cargo doc $(CARGO_BUILD) --no-deps

# The compiler counts the ways taken through the program, in a build folder of its own. Without the
# network library that takes some minutes. --target keeps build scripts out of it.
FUZZ_SECONDS = 60
# In memory, where there is such a folder: every damaged file is written.
FUZZ_TMP     = $(or $(wildcard /dev/shm),/tmp)
FUZZ_FLAGS   = -Cpasses=sancov-module -Cllvm-args=-sanitizer-coverage-level=3 \
	-Cllvm-args=-sanitizer-coverage-inline-8bit-counters -Ccodegen-units=1 -Clink-arg=-Wl,-z,nostart-stop-gc
FUZZ_HOST    = $(shell rustc -vV | sed -n 's/^host: //p')
fuzz: export CARGO_TARGET_DIR := $(CARGO_TARGET_DIR)-fuzz
fuzz: export RUSTFLAGS := $(FUZZ_FLAGS)
fuzz: ## damaged files for every reader, FUZZ_SECONDS=60 each; what breaks one is left in fuzz/crashes
	cargo build --release -p barchan-fuzz --target $(FUZZ_HOST) $(CARGO_FLAGS)
	@program=$(CARGO_TARGET_DIR)/$(FUZZ_HOST)/release/barchan-fuzz; failed=0; \
	for reader in $$($$program list); do TMPDIR=$(FUZZ_TMP) $$program $$reader $(FUZZ_SECONDS) || failed=1; done; exit $$failed

KILLS = 50
faults: ## KILLS=50 ends of train, slam and map at random moments: what was finished is whole
	BARCHAN_KILLS=$(KILLS) cargo test $(CARGO_BUILD) --test end_to_end faults:: survival::killed -- --nocapture

RATE    = 10
SECONDS_OF_LOAD = 600
load: build onnxruntime ## RATE=10 pairs a second of 484x366 into barchan serve, SECONDS_OF_LOAD=600: lost answers, times, memory
	$(PYTHON) scripts/load.py "$(BARCHAN)" --model "$(MODEL)" --rate $(RATE) --seconds $(SECONDS_OF_LOAD)

dist: ## the program without symbols and the licences of its crates, for packages (compiles the network library again)
	cargo build --profile dist $(CARGO_FLAGS)
	$(PYTHON) scripts/licences.py > $(CARGO_TARGET_DIR)/dist/LICENCES.txt

bench: onnxruntime ## timings of the main job, step by step
	cargo bench --workspace --bench main_job --bench terrain $(CARGO_FLAGS)

peers: build onnxruntime $(PEERS)/ready ## outputs against other people's programs: ONNX Runtime, evo, GDAL, OpenCV, Open3D (0.6 GB to fetch)
	$(PEERS)/bin/python tests/peers/run.py --barchan "$(BARCHAN)"

$(PEERS)/ready: tests/peers/requirements.txt
	$(PYTHON) -m venv --clear $(PEERS)
	$(PEERS)/bin/python -m pip install --quiet --no-deps --only-binary :all: --requirement $<
	touch $@

weights: build onnxruntime ## the weights of rover from nothing, into runs/weights; hours; after a stop it goes on
	scripts/weights.sh "$(BARCHAN)" runs/weights

onnx-weights: build onnxruntime ## checkpoints/rover.onnx and rover-int8.onnx, of the shipped weights
	$(BARCHAN) export rover --out checkpoints/rover.onnx
	$(BARCHAN) export rover --int8 --calibrate synth:scenes,seed=99,frames=24,width=320,height=256,bare=3 \
		--out checkpoints/rover-int8.onnx

accuracy: build onnxruntime $(PEERS)/ready ## MODEL=rover on pairs it never saw, beside OpenCV's SGBM; 100 rendered seeds (5 minutes)
	$(PEERS)/bin/python tests/peers/accuracy.py --barchan "$(BARCHAN)" --model "$(MODEL)"

peers-torch: build onnxruntime $(PEERS_TORCH)/ready ## the network in pure PyTorch: weights both ways, gradients, time of a step (1 GB to fetch)
	$(PEERS_TORCH)/bin/python tests/peers/run_torch.py --barchan "$(BARCHAN)"

$(PEERS_TORCH)/ready: $(TORCH_PINS)
	$(PYTHON) -m venv --clear $(PEERS_TORCH)
	$(PEERS_TORCH)/bin/python -m pip install --quiet --no-deps --only-binary :all: --requirement $<
	$(PEERS_TORCH)/bin/python scripts/torch_cpu.py
	touch $@

SITES = synth:seed=11,frames=150 synth:seed=12,frames=150,look=moon \
	synth:seed=13,frames=150,look=arena synth:seed=14,frames=150,look=devon
vocabularies: build ## the visual words that slam ships, from renders (2 minutes)
	$(BARCHAN) vocabulary $(SITES:%=--data %,width=484,height=366) --out slam/src/vocabulary-orb.txt
	$(BARCHAN) vocabulary $(SITES:%=--data %,width=484,height=366) --features akaze --depth 3 \
		--out slam/src/vocabulary-akaze.txt

onnxruntime: ## ONNX Runtime's library into the cache, where barchan looks for it
	@$(PYTHON) scripts/onnxruntime.py

libtorch: ## libtorch into the cache, for the optional tch device (0.9 GB to fetch, 0.5 GB kept)
	@$(PYTHON) scripts/libtorch.py

sample-data: ## Middlebury's Motorcycle, a real pair with true disparity, into data/
	@$(PYTHON) scripts/sample_data.py data

clean: ## removes runs/demo, runs/peers, the sample data and what was compiled of barchan itself
	rm -rf runs/demo runs/peers data/motorcycle data/middlebury2014/trainingQ/Motorcycle
	cargo clean --workspace
