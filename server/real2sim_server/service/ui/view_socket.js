// The view socket: the newest request is sent once the last answer has arrived.
import { token, WORKER } from "./api.js";

export class ViewSocket {
  constructor(id, { onFrame, onPick, onChanged, onError, onGone }) {
    Object.assign(this, {
      id,
      onFrame,
      onPick,
      onChanged,
      onError,
      onGone,
      busy: false,
      next: null,
      seq: 0,
    });
    this.connect();
  }
  connect() {
    const base = WORKER.replace(/^http/, "ws");
    this.socket = new WebSocket(`${base}/v1/scenarios/${encodeURIComponent(this.id)}/view`);
    this.socket.binaryType = "arraybuffer";
    this.ready = false;
    this.socket.onopen = () => this.socket.send(JSON.stringify({ type: "hello", token: token() }));
    this.socket.onmessage = ({ data }) =>
      typeof data === "string" ? this.text(JSON.parse(data)) : this.frame(data);
    this.socket.onclose = ({ code, reason }) => {
      this.busy = this.ready = false;
      this.next ??= this.last;
      if (code >= 4400) {
        this.onError(reason);
      } else {
        this.onGone(true);
        setTimeout(() => this.connect(), 1000);
      }
    };
  }
  // Switch to another scenario.
  turnTo(id) {
    this.socket.onclose = this.socket.onmessage = null;
    this.socket.close();
    this.id = id;
    this.busy = false;
    this.next ??= this.last;
    this.connect();
  }
  requestFrame(request) {
    this.next = this.last = request;
    this.flush();
  }
  pick(request) {
    if (this.ready) {
      this.socket.send(JSON.stringify({ ...request, seq: ++this.seq }));
    }
  }
  flush() {
    if (!this.ready || this.busy || !this.next) {
      return;
    }
    this.busy = true;
    this.socket.send(JSON.stringify({ ...this.next, seq: ++this.seq }));
    this.next = null;
  }
  text(message) {
    if (message.type === "welcome") {
      this.ready = true;
      this.onGone(false);
      this.flush();
      return;
    }
    if (message.type === "picked") {
      this.onPick(message.object_id);
    }
    if (message.type === "changed") {
      this.onChanged();
    }
    if (message.type === "error") {
      this.busy = false;
      this.onError(message.detail);
      this.flush();
    }
  }
  frame(data) {
    const size = new DataView(data).getUint32(0, true);
    const header = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, size)));
    this.busy = false;
    this.flush();
    this.onFrame(header, new Blob([new Uint8Array(data, 4 + size)], { type: "image/jpeg" }));
  }
}
