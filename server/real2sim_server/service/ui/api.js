// Calls of the worker's REST interface. Problems become sentences.
const KEY = "real2sim-token";
// Address of the worker, without a slash at its end; a proxy may serve it below a path.
export const WORKER = new URL("..", import.meta.url).href.replace(/\/$/, "");
export const token = () => sessionStorage.getItem(KEY) ?? "";

export class ApiError extends Error {
  constructor(problem, status) {
    const detail = problem.detail ?? `the worker answered with status ${status}`;
    super(sentence(problem.hint ? `${detail}: ${problem.hint}` : detail));
    this.code = problem.code;
    this.status = status;
  }
}

export const sentence = (text) => {
  const trimmed = text.trim();
  const end = /[.!?]$/.test(trimmed) ? "" : ".";
  return trimmed.charAt(0).toUpperCase() + trimmed.slice(1) + end;
};

export async function call(method, path, { body, headers = {}, accept = "application/json" } = {}) {
  const given = { Accept: accept, "X-Real2Sim-Client": "studio", ...headers };
  if (token()) {
    given.Authorization = `Bearer ${token()}`;
  }
  if (body !== undefined) {
    given["Content-Type"] = "application/json";
  }
  let answer;
  try {
    const content = body === undefined ? undefined : JSON.stringify(body);
    answer = await fetch(WORKER + path, { method, headers: given, body: content });
  } catch {
    throw new Error("The worker does not answer. Is it still running?");
  }
  if (answer.status === 401) {
    await askForToken();
    return call(method, path, { body, headers, accept });
  }
  if (!answer.ok) {
    throw new ApiError(await answer.json().catch(() => ({})), answer.status);
  }
  return answer;
}

export const get = async (path) => (await call("GET", path)).json();
export const post = async (path, body, headers) =>
  (await call("POST", path, { body, headers })).json();
export const picture = async (path, accept = "image/jpeg") =>
  URL.createObjectURL(await (await call("GET", path, { accept })).blob());

// Server-sent events of a path, one object each, until the worker ends them.
export async function* events(path) {
  const { body } = await call("GET", path, { accept: "text/event-stream" });
  const reader = body.pipeThrough(new TextDecoderStream()).getReader();
  let text = "";
  for (;;) {
    const { value, done } = await reader.read();
    if (done) {
      return;
    }
    text += value;
    const messages = text.split("\n\n");
    text = messages.pop();
    for (const message of messages) {
      const data = message
        .split("\n")
        .filter((line) => line.startsWith("data: "))
        .map((line) => line.slice(6))
        .join("");
      if (data) {
        yield JSON.parse(data);
      }
    }
  }
}

let asking = null;
export function askForToken() {
  asking ??= new Promise((done) => {
    const dialog = document.getElementById("token");
    dialog.showModal();
    dialog.addEventListener(
      "close",
      () => {
        sessionStorage.setItem(KEY, dialog.querySelector("input").value);
        asking = null;
        done();
      },
      { once: true },
    );
  });
  return asking;
}
