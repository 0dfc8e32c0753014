"""Judges: whoever reads clips for the reward agent. Here: any server that speaks chat completions, such as vLLM.

    vllm serve MODEL --enable-prefix-caching --limit-mm-per-prompt '{"image": 40, "video": 1}'

    transport = ChatTransport([Endpoint("http://127.0.0.1:8000/v1", "MODEL")])
    judge = OpenAIJudge(transport, rubric, load_config("cpu").judge, VerdictCache(folder))
    agent = RewardAgent(judge, rubric)

A profile sends up to 32 images. Keys come from environment variables only (Endpoint.api_key_env). Label votes need a
server with logprobs; `transformers serve` has none, so votes after the first are errors there.
"""
