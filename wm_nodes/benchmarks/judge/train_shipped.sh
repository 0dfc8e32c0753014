#!/bin/bash
# Record the data of a shipped judge and train it, below runs/ of the repository's root, where this is called:
#     bash wm_nodes/benchmarks/judge/train_shipped.sh clip_judge        six and a half hours of one core
#     bash wm_nodes/benchmarks/judge/train_shipped.sh policy_judge      an hour of two cores
set -eu
repo=$PWD; wm() { python3 $repo/launch_scripts/wm.py "$@"; }
make() { name=$1; shift; wm build-judge-dataset runs/sets/$name "$@"; }
train() { (cd runs/sets; wm train-judge "$@"); }

clip_judge() {
    dev() { make $1 --edits 26 --development --tasks $2 --episodes $3 --seed $4; }
    dev s00 push_cube 80 1000; dev s01b push_cube 80 1080; dev s02 push_cube 60 3000
    dev t00 pull_cube 60 1000; dev t01 pull_cube 60 1100; dev r00 reach 60 1000; dev r01 reach 60 1100
    drawn() { make $1 --edits 26 --diverse --tasks $2 --episodes $3 --seed $4; }
    for i in {00..19}; do drawn d$i push_cube 40 $((40000 + 10#$i * 100)); done
    for i in {00..13}; do drawn e$i pull_cube 40 $((50000 + 10#$i * 100)); done
    drawn q00 reach 20 40000; drawn q01 reach 20 40100; for i in 2 3 4; do drawn q0$i reach 40 40${i}00; done
    k() { make k$1 --edits 0 --stacks 6 "${@:2}"; }      # stacked edits on recordings of above
    k t00 --development --tasks pull_cube --episodes 60 --seed 1000; k t01 --development --tasks pull_cube --episodes 60 --seed 1100
    k s00 --development --tasks push_cube --episodes 80 --seed 1000
    for i in {00..09}; do k e$i --diverse --tasks pull_cube --episodes 40 --seed $((50000 + 10#$i * 100)); done
    for i in {00..05}; do k d$i --diverse --tasks push_cube --episodes 40 --seed $((40000 + 10#$i * 100)); done
    train ../judge0 s00 r00 t00 r01 d0{0..8} q00 q01 e00 e01 e02 --segmenter-steps 6300 --readers 0      # the segmenter
    mkdir runs/judge && cp runs/judge0/segmenter.* runs/judge
    train ../judge s00 s01b s02 t00 t01 r00 r01 d{00..19} e{00..13} q0{0..4} kt00 kt01 ks00 ke{00..09} kd{00..05} --segmenter-steps 6300
}

policy_judge() {
    view() { make $1 --policy-view --development "${@:2}"; }
    both() { view $1 --edits 26 "${@:2}"; view k$1 --edits 0 --stacks 6 "${@:2}"; }
    push() { both $1 --tasks push_cube --episodes 60 --seed "${@:2}"; }
    push pa 60000; push pb 60100; push pd 60300; push pe 60500; push pf 60600; push pg 60700
    view pc --edits 26 --tasks push_cube --episodes 20 --seed 60200; push va 60400 --stride 2; push vb 60800 --stride 2
    both ra --tasks reach --episodes 60 --seed 60000; both rb --tasks reach --episodes 60 --seed 60100
    few() { view $1 --edits 9 --stacks 3 "${@:2}"; }
    few pm --tasks push_cube --episodes 150 --seed 62000; few pn --tasks push_cube --episodes 150 --seed 62400
    few vm --tasks push_cube --episodes 80 --seed 62800 --stride 2; few rm --tasks reach --episodes 80 --seed 62000
    train ../policy_judge0 pa pb pc va --policy-view --readers 0 --threads 2      # the segmenter
    mkdir runs/policy_judge && cp runs/policy_judge0/segmenter.* runs/policy_judge
    train ../policy_judge pa pb pc ra va kpa kpb kra kva pd pe pf pg rb vb kpd kpe kpf kpg krb kvb pm pn vm rm --policy-view
}

case "${1:-}" in
    clip_judge|policy_judge) "$1" ;;
    *) echo "name the judge to train: clip_judge or policy_judge" >&2; exit 2 ;;
esac
