"""A Slurm cluster of one node on the loopback address, for as long as a drill takes: munge, slurmctld and slurmd.

Needs root and the Debian packages munge, slurmctld, slurmd and slurm-client. Everything
lies in one folder; nothing of /etc/slurm is read.
"""

import os
import secrets
import socket
import subprocess
import time

CONFIG = """
ClusterName=drill
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={ports[0]}
SlurmdPort={ports[1]}
SrunPortRange={ports[2]}-{ports[3]}
CommunicationParameters=NoInAddrAny,NoCtldInAddrAny
AuthType=auth/munge
AuthInfo=socket={place}/munge/socket
CredType=cred/munge
SlurmUser=root
SlurmdUser=root
StateSaveLocation={place}/state
SlurmdSpoolDir={place}/spool
SlurmctldPidFile={place}/slurmctld.pid
SlurmdPidFile={place}/slurmd.pid
SlurmctldLogFile={place}/slurmctld.log
SlurmdLogFile={place}/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
MpiDefault=none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
AccountingStorageType=accounting_storage/none
JobAcctGatherType=jobacct_gather/none
KillWait=10
ReturnToService=2
NodeName={host} NodeAddr=127.0.0.1 CPUs=2 RealMemory=8000 State=UNKNOWN
PartitionName=main Nodes=ALL Default=YES MaxTime=60 State=UP
"""


class Cluster:
    """Two CPUs and 8 GB, without accounting; `with Cluster(folder) as cluster:` starts
    and stops it.
    """

    def __init__(self, directory):
        """Write its configuration below `place`."""
        self.directory, self._daemons, self.clients = directory, [], []
        for name, mode in (("munge", 0o755), ("state", 0o700), ("spool", 0o755)):
            (directory / name).mkdir(mode=mode)
        directory.chmod(0o755)
        key = directory / "munge/key"
        key.write_bytes(secrets.token_bytes(128))
        key.chmod(0o400)
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            first = min(free.getsockname()[1], 65000)
        ports = (first, first + 1, first + 2, first + 99)
        self._config = directory / "slurm.conf"
        self._config.write_text(
            CONFIG.format(directory=directory, host=socket.gethostname(), ports=ports)
        )
        self.env = os.environ | {"SLURM_CONF": str(self._config)}

    def __enter__(self):
        """Start the daemons, and wait until the node is idle."""
        munge = self.directory / "munge"
        files = [
            f"--{name}-file={munge / name}" for name in ("key", "log", "pid", "seed")
        ]
        self._start("munged", "--foreground", f"--socket={munge / 'socket'}", *files)
        self._until(lambda: (munge / "socket").exists(), "munged")
        self._start("slurmctld", "-D", "-f", str(self._config))
        self._start("slurmd", "-D", "-f", str(self._config))
        self._until(
            lambda: "idle" in self.ask("sinfo", "--noheader", "--format=%T"), "slurmd"
        )
        return self

    def __exit__(self, *_):
        """Stop who waits for jobs, cancel what runs, and stop the daemons in the
        reverse order.
        """
        for client in self.clients:
            if client.poll() is None:
                client.kill()
        self.ask("scancel", "--full", "--state=running")
        self.ask("scancel", "--me")
        time.sleep(2)
        for daemon in reversed(self._daemons):
            daemon.terminate()
            daemon.wait(30)

    def ask(self, *command):
        """What a command of Slurm says."""
        done = subprocess.run(
            command, env=self.env, capture_output=True, text=True, check=False
        )
        return done.stdout + done.stderr

    def jobs(self):
        """State by job id, of those that Slurm remembers."""
        message = self.ask(
            "squeue", "--me", "--array", "--states=all", "--noheader", "--format=%i %T"
        )
        return dict(line.split() for line in message.splitlines())

    def _start(self, *command):
        log = (self.directory / f"{command[0]}.out").open("w")
        self._daemons.append(
            subprocess.Popen(
                command, env=self.env, stdout=log, stderr=log, start_new_session=True
            )
        )

    def _until(self, done, name, seconds=60):
        began = time.monotonic()
        while not done():
            if time.monotonic() - began > seconds:
                raise SystemExit(
                    f"{name} did not start: {(self.place / f'{name}.out').read_text()[-500:]}"
                )
            time.sleep(0.5)
